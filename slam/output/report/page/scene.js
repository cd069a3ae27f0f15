// SPDX-License-Identifier: Apache-2.0
// Path, loops and map in space.
"use strict";

const scene = (() => {
  const div = el("scene");
  const STAGE_COLOURS = ["before", "without", "after"];
  const TRACE = {
    map: 0,
    truth: 1,
    odometry: 2,
    range: 3,
    path: 4,
    loops: 5,
    chosen: 8,
    lost: 9,
    mark: 10,
  };
  const GROUPS = ["accepted", "outvoted", "false"];
  const reference = frames.truth || frames.stages[2];
  const compared = frames.truth || frames.stages[1]; // what is far from it is wrong, or corrected
  const map = data.map && worldMap();
  let stage = 2;
  let shown = []; // where the path is drawn
  let chosenLoop = -1;
  let range = null;
  const wanted = new Map(); // changes that are not drawn yet, by trace
  let isDrawing = false;

  function enlarged(xyz) {
    const factor = Number(el("enlargement").value);
    return xyz.map((value, i) =>
      Number.isNaN(reference[i]) ? value : reference[i] + factor * (value - reference[i]),
    );
  }

  const keyframeFrame = (keyframe) => data.keyframes.frames[keyframe];

  /** Return a line over each loop, with a mark in its middle. */
  function loopLines(group) {
    const lines = { x: [], y: [], z: [] };
    data.loops.forEach((loop) => {
      const [a, b] = loop.pair.map(keyframeFrame);
      if (loop.group !== group || a < 0 || b < 0) return;
      ["x", "y", "z"].forEach((name, i) => {
        const ends = [shown[3 * a + i], shown[3 * b + i]];
        lines[name].push(ends[0], (ends[0] + ends[1]) / 2, ends[1], null);
      });
    });
    return lines;
  }

  /** Return the loops that can be clicked: number and both ends, doubtful ones first. */
  function shownLoops() {
    if (!el("showloops").checked) return [];
    const at = (frame) => [0, 1, 2].map((axis) => shown[3 * frame + axis]);
    return data.loops
      .map((loop, number) => [number, ...loop.pair.map(keyframeFrame)])
      .filter(([number, a, b]) => data.loops[number].group !== "rejected" && a >= 0 && b >= 0)
      .map(([number, a, b]) => [number, at(a), at(b)]);
  }

  function chosenLine() {
    const loop = data.loops[chosenLoop];
    const ends = loop ? loop.pair.map(keyframeFrame) : [];
    return points(
      shown,
      ends.filter((frame) => frame >= 0),
    );
  }

  function lengths(xyz) {
    return order.map((frame) => {
      if (frame < 0) return null;
      const i = 3 * frame;
      const cm = 100 * Math.hypot(...[0, 1, 2].map((k) => xyz[i + k] - compared[i + k]));
      return Number.isNaN(cm) ? null : cm;
    });
  }

  /** Return the frames to join: where errors are told by colour, those whose error is known. */
  function pathOrder() {
    if (el("colour").value !== "error") return order;
    return order.map((frame) => (Number.isNaN(compared[3 * frame]) ? -1 : frame));
  }

  function pathLook(xyz) {
    const kind = el("colour").value;
    const nearest = Math.round(stage);
    const look = { width: 5, showscale: false };
    if (kind === "plain") return { ...look, color: colour(STAGE_COLOURS[nearest]) };
    const most = Math.max(
      ...data.frames.curves.flatMap((curve) => [...floats(curve.lengths)].filter((cm) => cm >= 0)),
      1e-6,
    );
    const isError = kind === "error";
    return {
      ...look,
      showscale: true,
      colorscale: "Viridis",
      color: isError ? lengths(xyz) : along(frames.times_s),
      cmin: 0,
      cmax: isError ? most : frames.times_s.at(-1),
      colorbar: { title: { text: isError ? "cm" : "s" }, thickness: 12, len: 0.6 },
    };
  }

  /** Return what changes as the path moves: traces' numbers and their coordinates. */
  function moving() {
    const xyz = between(frames.stages, stage);
    shown = enlarged(xyz);
    const inRange = order.map((frame) =>
      range && frame >= range[0] && frame <= range[1] ? frame : -1,
    );
    const parts = [
      [TRACE.range, { ...points(shown, inRange), customdata: order }],
      [
        TRACE.path,
        {
          ...points(shown, pathOrder()),
          customdata: order,
          line: pathLook(xyz),
          name: `slider: ${STAGES[Math.round(stage)]}`,
        },
      ],
      ...GROUPS.map((group, i) => [TRACE.loops + i, loopLines(group)]),
      [TRACE.chosen, chosenLine()],
      [TRACE.lost, points(shown, data.lost_frames)],
    ];
    if (map) parts.unshift([TRACE.map, points(between(map.stages, stage), map.numbers)]);
    return new Map(parts);
  }

  function traces() {
    const isShown = (id) => el(id).checked;
    const line = (name, tint, width, more) => ({
      type: "scatter3d",
      mode: "lines",
      name,
      line: { color: colour(tint), width },
      hoverinfo: "name",
      ...more,
    });
    const all = [];
    all[TRACE.map] = {
      type: "scatter3d",
      mode: "markers",
      name: "map",
      hoverinfo: "skip",
      showlegend: false,
      visible: isShown("showmap"),
      x: [],
      y: [],
      z: [],
      marker: { size: 1.6, symbol: "square", color: map ? map.colours : [] }, // two triangles each
    };
    all[TRACE.truth] = line("ground truth", "truth", 7, {
      visible: Boolean(frames.truth),
      opacity: 0.6,
      ...points(reference, order),
      customdata: order,
    });
    all[TRACE.odometry] = line("odometry", "before", 2, {
      ...points(enlarged(frames.stages[0]), order),
      customdata: order,
    });
    all[TRACE.range] = line("chosen stretch", "chosen", 11, { showlegend: false });
    all[TRACE.path] = line("", "after", 5, {
      hovertemplate: "%{text}<extra></extra>",
      text: order.map((frame) => (frame < 0 ? "" : `${frames.times_s[frame].toFixed(2)} s`)),
    });
    GROUPS.forEach((group, i) => {
      const tint = LOOP_COLOURS[group];
      all[TRACE.loops + i] = line(`${group} loops`, tint, group === "accepted" ? 1.5 : 4, {
        mode: "lines+markers",
        visible: isShown("showloops"),
        showlegend: data.loops.some((loop) => loop.group === group),
        hovertemplate: "%{text}<extra></extra>",
        text: data.loops
          .filter((loop) => loop.group === group && loop.pair.every((k) => keyframeFrame(k) >= 0))
          .flatMap((loop) =>
            Array(4).fill(`${group} loop, keyframes ${loop.pair.join(" and ")}: click`),
          ),
        opacity: group === "accepted" ? 0.7 : 1,
        marker: {
          size: group === "accepted" ? 3 : 6,
          color: colour(tint),
          symbol: group === "accepted" ? "circle" : "diamond",
        },
      });
    });
    all[TRACE.chosen] = line("chosen loop", "chosen", 8, {
      mode: "lines+markers",
      showlegend: false,
      marker: { size: 8, color: colour("chosen") },
      hoverinfo: "skip",
    });
    all[TRACE.lost] = {
      type: "scatter3d",
      mode: "markers",
      name: "tracking lost",
      showlegend: data.lost_frames.length > 0,
      marker: { symbol: "x", size: 5, color: colour("lost") },
      hoverinfo: "name",
    };
    all[TRACE.mark] = {
      type: "scatter3d",
      mode: "markers",
      x: [],
      y: [],
      z: [],
      showlegend: false,
      hoverinfo: "skip",
      marker: { size: 7, color: colour("ink") },
    };
    for (const [number, coordinates] of moving()) Object.assign(all[number], coordinates);
    return all;
  }

  // The plane in which the camera walks, seen from above: right, away, up.
  const upAxis = data.up.findIndex((value) => value !== 0);
  const sign = data.up[upAxis];
  const plane = [(upAxis + 1) % 3, (upAxis + 2) % 3];
  if (sign < 0) plane.reverse();
  const VIEWS = {
    corner: [0.65, -0.9, 0.6],
    above: [0, -0.01, 1.4],
    front: [0, -1.4, 0.15],
    side: [1.4, 0, 0.15],
  };

  function eye([right, away, up]) {
    const at = [0, 0, 0];
    at[plane[0]] = right;
    at[plane[1]] = away;
    at[upAxis] = sign * up;
    return { x: at[0], y: at[1], z: at[2] };
  }

  function cameraAt(view) {
    const [x, y, z] = data.up;
    const farther = Math.max(1, (1.2 * div.clientHeight) / div.clientWidth); // where it is narrow
    return {
      up: { x, y, z },
      eye: eye(view.map((step) => farther * step)),
      center: { x: 0, y: 0, z: 0 },
    };
  }

  const look = (camera) => Plotly.relayout(div, { "scene.camera": camera });

  function turn(event) {
    const steps = {
      ArrowLeft: [-1, 0, 0],
      ArrowRight: [1, 0, 0],
      ArrowUp: [0, 1, 0],
      ArrowDown: [0, -1, 0],
      "+": [0, 0, -1],
      "-": [0, 0, 1],
    };
    const step = steps[event.key];
    if (!step) return;
    event.preventDefault();
    const camera = div._fullLayout.scene._scene.getCamera();
    const at = [camera.eye.x, camera.eye.y, camera.eye.z];
    const [right, away, up] = [at[plane[0]], at[plane[1]], sign * at[upAxis]];
    const flat = Math.hypot(right, away);
    const far = Math.hypot(flat, up) * 1.15 ** step[2];
    const around = Math.atan2(away, right) + 0.12 * step[0];
    const high = Math.min(1.5, Math.max(-1.5, Math.atan2(up, flat) + 0.12 * step[1]));
    const flatter = far * Math.cos(high);
    look({
      ...camera,
      eye: eye([flatter * Math.cos(around), flatter * Math.sin(around), far * Math.sin(high)]),
    });
  }

  function draw() {
    const side = (name) => ({
      title: { text: `${name} (m)` },
      color: colour("soft"),
      gridcolor: colour("line"),
      showbackground: false,
      zerolinecolor: colour("line"),
      showspikes: false,
    });
    return Plotly.react(
      div,
      traces(),
      layout({
        margin: { l: 0, r: 0, t: 0, b: 0 },
        hovermode: "closest",
        legend: { orientation: "h", y: 1, yanchor: "top", x: 0, bgcolor: "rgba(0,0,0,0)" },
        scene: {
          aspectmode: "data",
          xaxis: side("x"),
          yaxis: side("y"),
          zaxis: side("z"),
          dragmode: "orbit",
          camera: div._fullLayout?.scene._scene.getCamera() ?? cameraAt(VIEWS.corner), // as turned
        },
      }),
      { ...PLOT, toImageButtonOptions: { format: "png", scale: 3, filename: "path" } },
    );
  }

  function tellStage() {
    const name = Number.isInteger(stage)
      ? STAGES[stage]
      : `between ${STAGES[Math.floor(stage)]} and ${STAGES[Math.ceil(stage)]}`;
    el("stagename").value = name;
    el("stage").setAttribute("aria-valuetext", name);
    el("enlarged").textContent =
      el("enlargement").value === "1"
        ? ""
        : `Distances from ${frames.truth ? "ground truth" : "the path with loops"} are drawn ` +
          `${el("enlargement").value} times as large as they are; the map is not.`;
  }

  function move() {
    tellStage();
    change([...moving()]);
  }

  /** Change traces: all that is wanted at once, for each change draws everything anew. */
  function change(parts) {
    for (const [trace, part] of parts) wanted.set(trace, { ...wanted.get(trace), ...part });
    if (!isDrawing) drawWanted();
  }

  function drawWanted() {
    isDrawing = true;
    requestAnimationFrame(async () => {
      const parts = [...wanted];
      wanted.clear();
      const values = ["x", "y", "z", "line", "name"].map((name) => [
        name,
        parts.map(([trace, part]) => part[name] ?? div.data[trace][name]),
      ]);
      await Plotly.restyle(
        div,
        Object.fromEntries(values),
        parts.map(([trace]) => trace),
      );
      isDrawing = false;
      if (wanted.size) drawWanted();
    });
  }

  function start() {
    draw();
    tellStage();
    picking.onClick(div, shownLoops, loops.select);
    div.on("plotly_hover", (event) => {
      const { curveNumber, customdata } = event.points[0];
      if ([TRACE.path, TRACE.odometry, TRACE.truth].includes(curveNumber) && customdata >= 0)
        charts.mark(customdata);
    });
    div.addEventListener("keydown", turn);
    el("viewpoint").addEventListener("change", (event) =>
      look(cameraAt(VIEWS[event.target.value])),
    );
    for (const id of ["colour", "showmap", "showloops"]) el(id).addEventListener("change", draw);
    el("enlargement").addEventListener("change", () => {
      draw();
      tellStage();
    });
    el("stage").addEventListener("input", (event) => {
      stage = Number(event.target.value);
      move();
    });
  }

  return {
    start,
    draw,
    /** Show which loop is looked at. */
    select(number) {
      chosenLoop = number;
      change([[TRACE.chosen, chosenLine()]]);
    },
    /** Show a frame that the pointer is at in a chart. */
    mark(frame) {
      change([[TRACE.mark, points(shown, [frame])]]);
    },
    /** Show a stretch, first and last frame, that a chart was zoomed to; null for all. */
    choose(stretch) {
      range = stretch;
      change([[TRACE.range, moving().get(TRACE.range)]]);
    },
  };
})();
