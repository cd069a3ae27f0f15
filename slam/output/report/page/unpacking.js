// SPDX-License-Identifier: Apache-2.0
// The numbers that the page holds, and what all of its parts need.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const el = (id) => document.getElementById(id);
const bytes = (packed) => Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
const floats = (packed) => new Float32Array(bytes(packed).buffer);
const colour = (name) =>
  getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

const frames = {
  times_s: floats(data.frames.times_s),
  travelled_m: floats(data.frames.travelled_m),
  stages: data.frames.stages.map(floats), // x y z of each frame, in the order of STAGES
  truth: data.frames.truth && floats(data.frames.truth),
};
// Loops of which there are numbers alone come after those that are listed, and cannot be selected.
const KINDS = ["accepted", "false", "outvoted", "rejected"];
const [otherPairs, otherSimilarities] = [data.others.pairs, data.others.similarities].map(floats);
const everyLoop = data.loops.concat(
  data.others.groups.map((group, i) => ({
    pair: [...otherPairs.subarray(2 * i, 2 * i + 2)],
    group: KINDS[group],
    similarity: Number.isNaN(otherSimilarities[i]) ? null : otherSimilarities[i],
  })),
);
const STAGES = ["odometry", "without loops", "with loops"];
const LOOP_COLOURS = { accepted: "after", false: "wrong", outvoted: "before", rejected: "before" };

// Frames in order, -1 where a line is interrupted.
const order = [];
for (let frame = 0, next = 0; frame < frames.times_s.length; frame += 1) {
  if (frame === data.frames.breaks[next]) {
    order.push(-1);
    next += 1;
  }
  order.push(frame);
}

const along = (values) => order.map((frame) => (frame < 0 ? null : values[frame]));

/** Return { x, y, z } of the points with these numbers; -1 interrupts. */
function points(xyz, numbers) {
  const part = (axis) =>
    numbers.map((i) => (i < 0 || Number.isNaN(xyz[3 * i]) ? null : xyz[3 * i + axis]));
  return { x: part(0), y: part(1), z: part(2) };
}

/** Return what lies between stages 0, 1 and 2, whose arrays are given. */
function between(stages, stage) {
  const first = Math.min(Math.floor(stage), 1);
  const share = stage - first;
  return stages[first].map((value, i) => value + share * (stages[first + 1][i] - value));
}

const PLOT = {
  displaylogo: false,
  responsive: true,
  displayModeBar: "hover",
  showSendToCloud: false,
  plotlyServerURL: "", // nobody's recording leaves this page
  modeBarButtonsToRemove: [
    "select2d",
    "lasso2d",
    "autoScale2d",
    "resetCameraLastSave3d",
    "tableRotation",
    "zoom3d",
  ],
};

/** Return the layout that all plots share, in the page's colours. */
function layout(more) {
  return {
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: colour("ink") },
    margin: { l: 52, r: 12, t: 8, b: 42 },
    legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 },
    hoverlabel: { bgcolor: colour("card"), font: { color: colour("ink") } },
    modebar: {
      orientation: "v",
      bgcolor: "rgba(0,0,0,0)",
      color: colour("soft"),
      activecolor: colour("after"),
    },
    uirevision: "kept",
    ...more,
  };
}

const axis = (title, more) => ({
  title: { text: title, standoff: 8 },
  gridcolor: colour("line"),
  zerolinecolor: colour("line"),
  linecolor: colour("line"),
  ...more,
});
