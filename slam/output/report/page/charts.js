// SPDX-License-Identifier: Apache-2.0
// Drift along the run, and how alike places are: flat plots.
"use strict";

const charts = (() => {
  const save = (filename) => ({ ...PLOT, toImageButtonOptions: { format: "svg", filename } });
  const far = () => frames[el("along").value];
  let marked = -1;

  function drawDrift() {
    const measure = el("measure").value;
    const isPerMetre = measure === "per_metre";
    const x = along(far());
    const traces = data.frames.curves.map((curve) => ({
      type: "scatter",
      mode: "lines",
      name: curve.name,
      x,
      y: along(floats(curve[measure])),
      customdata: order,
      line: { color: colour(curve.colour), width: 1.6 },
      hovertemplate: `%{y:.2f} ${isPerMetre ? "cm/m" : "cm"}`,
    }));
    for (const group of ["accepted", "outvoted", "false"]) {
      const numbers = everyLoop
        .map((_, i) => i)
        .filter(
          (i) => everyLoop[i].group === group && data.keyframes.frames[everyLoop[i].pair[1]] >= 0,
        );
      if (!numbers.length) continue;
      traces.push({
        type: "scatter",
        mode: "markers",
        name: `${group} loop`,
        customdata: numbers.map((i) => ({ loop: i })),
        x: numbers.map((i) => far()[data.keyframes.frames[everyLoop[i].pair[1]]]),
        y: numbers.map(() => 0),
        marker: {
          symbol: group === "accepted" ? "triangle-up" : "diamond",
          size: 9,
          color: colour(LOOP_COLOURS[group]),
        },
        text: numbers.map(
          (i) => `${group} loop, keyframes ${everyLoop[i].pair.join(" and ")}: click`,
        ),
        hovertemplate: "%{text}<extra></extra>",
        cliponaxis: false,
      });
    }
    const isTime = el("along").value === "times_s";
    const vertical = (at, tint, dash) => ({
      type: "line",
      x0: at,
      x1: at,
      yref: "paper",
      y0: 0,
      y1: 1,
      line: { color: colour(tint), width: 1, dash },
    });
    const shapes = isTime
      ? [
          ...data.lost_s
            .filter((_, i) => i % Math.ceil(data.lost_s.length / 300) === 0)
            .map((s) => vertical(s, "lost", "solid")),
          ...data.starts_s.map((s) => vertical(s - 0.5, "ink", "dot")),
        ]
      : [];
    if (marked >= 0) shapes.push(vertical(far()[marked], "ink", "solid"));
    const what = isPerMetre
      ? "error per metre (cm/m)"
      : `${data.in_truth_frame ? "position error" : "moved by loops"} (cm)`;
    return Plotly.react(
      "chart",
      traces,
      layout({
        xaxis: axis(isTime ? "time (s)" : "path travelled (m)", { uirevision: el("along").value }),
        yaxis: axis(what, { rangemode: "tozero", uirevision: measure }),
        hovermode: "closest",
        dragmode: "zoom",
        shapes,
      }),
      save("drift"),
    );
  }

  function stretch() {
    const { range, autorange } = el("chart")._fullLayout.xaxis;
    if (autorange) return null;
    const inside = [...far()]
      .map((x, frame) => (x >= range[0] && x <= range[1] ? frame : -1))
      .filter((frame) => frame >= 0);
    return inside.length ? [inside[0], inside.at(-1)] : null;
  }

  function matrixPicture({ shades }, isDark) {
    const { size } = data.matrices;
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = size;
    const pen = canvas.getContext("2d");
    const picture = pen.createImageData(size, size);
    const ink = colour("ink")
      .match(/\w\w/g)
      .map((part) => parseInt(part, 16));
    bytes(shades).forEach((shade, i) => {
      const strength = shade === 255 ? 0 : isDark(shade);
      picture.data.set([...ink, strength], 4 * i);
    });
    pen.putImageData(picture, 0, 0);
    return canvas.toDataURL();
  }

  function drawMatrix() {
    const shown = el("shown").value;
    const { size, step } = data.matrices;
    const symbols = {
      rejected: "x-thin-open",
      outvoted: "diamond-open",
      accepted: "circle-open",
      false: "diamond",
    };
    const traces = Object.keys(symbols).map((group) => {
      const numbers = everyLoop.map((_, i) => i).filter((i) => everyLoop[i].group === group);
      return {
        type: "scatter",
        mode: "markers",
        name: `${group} (${numbers.length})`,
        visible: numbers.length > 0,
        x: numbers.map((i) => everyLoop[i].pair[0]),
        y: numbers.map((i) => everyLoop[i].pair[1]),
        customdata: numbers,
        hovertemplate: "keyframes %{x} and %{y}: click<extra></extra>",
        marker: {
          symbol: symbols[group],
          size: 8,
          color: colour(LOOP_COLOURS[group]),
          line: { width: 1.6, color: colour(LOOP_COLOURS[group]) },
        },
      };
    });
    const last = (size - 0.5) * step;
    const image = {
      source: matrixPicture(
        data.matrices[shown],
        shown === "similarity" ? (shade) => shade : (shade) => 254 - shade,
      ),
      xref: "x",
      yref: "y",
      x: -0.5 * step,
      y: -0.5 * step,
      sizex: size * step,
      sizey: size * step,
      sizing: "stretch",
      layer: "below",
    };
    return Plotly.react(
      "matrix",
      traces,
      layout({
        xaxis: axis("earlier keyframe", {
          range: [-0.5 * step, last],
          showgrid: false,
          zeroline: false,
          constrain: "domain",
        }),
        yaxis: axis("later keyframe", {
          range: [last, -0.5 * step],
          showgrid: false,
          zeroline: false,
          scaleanchor: "x",
          constrain: "domain",
        }),
        images: [image],
        hovermode: "closest",
        dragmode: "zoom",
      }),
      save("matrix"),
    );
  }

  function tellCell(event) {
    const { xaxis, yaxis } = el("matrix")._fullLayout;
    const box = el("matrix").getBoundingClientRect();
    const { size, step } = data.matrices;
    const cell = (one, at) => Math.round(one.p2d(at - one._offset) / step);
    const [a, b] = [cell(xaxis, event.clientX - box.left), cell(yaxis, event.clientY - box.top)];
    const { low, high, shades } = data.matrices[el("shown").value];
    const isDistance = el("shown").value === "distance";
    const shade = a >= 0 && b >= 0 && a < size && b < size ? bytes(shades)[b * size + a] : 255;
    const value = low + (shade / 254) * (high - low);
    el("cell").value =
      shade === 255
        ? ""
        : `${a * step} and ${b * step}: ${value.toFixed(2)}${isDistance ? " m" : ""}`;
  }

  const steps = (edges, counts, name, tint) => ({
    type: "scatter",
    mode: "lines",
    name,
    x: edges,
    y: [...counts, 0],
    fill: "tozeroy",
    fillcolor: colour(tint),
    line: { shape: "hv", width: 0.5, color: colour(tint) },
    hovertemplate: "%{y} from %{x:.3f}",
  });

  const upright = (value, name, dash, top) => ({
    type: "scatter",
    mode: "lines",
    name: `${name} ${value.toFixed(3)}`,
    x: [value, value],
    y: [0, top],
    line: { color: colour("ink"), width: 1.3, dash },
    hoverinfo: "name",
  });

  function drawHistogram() {
    const known = everyLoop.filter((loop) => loop.similarity !== null);
    const seen = [data.min_similarity, ...known.map((loop) => loop.similarity)];
    const low = Math.min(...seen) - 1e-3;
    const width = (Math.max(...seen) + 1e-3 - low) / 30;
    const edges = Array.from({ length: 31 }, (_, i) => low + i * width);
    const count = (chosen) => {
      const counts = Array(30).fill(0);
      for (const loop of chosen) counts[Math.floor((loop.similarity - low) / width)] += 1;
      return counts;
    };
    const all = count(known);
    return Plotly.react(
      "histogram",
      [
        steps(edges, all, "rejected", "before"),
        steps(
          edges,
          count(known.filter((loop) => ["accepted", "false"].includes(loop.group))),
          "accepted",
          "after",
        ),
        upright(data.min_similarity, "threshold", "dash", Math.max(...all)),
      ],
      layout({ xaxis: axis("similarity"), yaxis: axis("candidates", { rangemode: "tozero" }) }),
      save("similarity"),
    );
  }

  function drawCalibrated() {
    const { counts, edges, threshold, different_places, same_place } = data.calibration;
    const top = Math.max(...counts, 1);
    const bar = (range, height, name, tint) => ({
      type: "scatter",
      mode: "lines",
      name,
      x: range,
      y: [height * top, height * top],
      line: { color: colour(tint), width: 8 },
      hoverinfo: "name",
    });
    return Plotly.react(
      "calibrated",
      [
        steps(edges, counts, "in this run", "truth"),
        bar(different_places, 1.16, "different places", "before"),
        bar(same_place, 1.07, "one place", "after"),
        upright(data.min_similarity, "verified from", "dash", 1.2 * top),
        upright(threshold, "tau", "dot", 1.2 * top),
      ],
      layout({
        xaxis: axis("similarity"),
        yaxis: axis("pairs of keyframes", { rangemode: "tozero" }),
      }),
      save("calibrated"),
    );
  }

  function draw() {
    drawDrift();
    drawMatrix();
    if (el("histogram")) drawHistogram();
    if (el("calibrated")) drawCalibrated();
  }

  function start(onStretch, onMark) {
    draw();
    const chart = el("chart");
    chart.on("plotly_relayout", (event) => {
      if (Object.keys(event).some((key) => key.startsWith("xaxis"))) onStretch(stretch());
    });
    chart.on("plotly_hover", (event) => {
      const frame = event.points[0].customdata;
      if (frame >= 0) onMark(frame);
    });
    chart.on("plotly_click", (event) => {
      const { loop } = Object(event.points[0].customdata);
      if (loop !== undefined) loops.select(loop);
    });
    el("matrix").on("plotly_click", (event) => loops.select(event.points[0].customdata));
    el("matrix").addEventListener("mousemove", tellCell);
    el("whole").addEventListener("click", () =>
      Plotly.relayout(chart, { "xaxis.autorange": true, "yaxis.autorange": true }),
    );
    el("measure").addEventListener("change", drawDrift);
    el("along").addEventListener("change", () => drawDrift().then(() => onStretch(stretch())));
    el("shown").addEventListener("change", drawMatrix);
  }

  return {
    start,
    draw,
    /** Show the frame that the pointer is at in space. */
    mark(frame) {
      if (frame === marked) return;
      marked = frame;
      drawDrift();
    },
  };
})();
