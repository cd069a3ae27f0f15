// SPDX-License-Identifier: Apache-2.0
// Brings the parts of the page to life, and together.
"use strict";

(() => {
  document.documentElement.classList.add("scripted");
  const probe = document.createElement("canvas");
  const hasWebGL = Boolean(probe.getContext("webgl2") || probe.getContext("webgl"));
  if (hasWebGL) scene.start();
  else {
    document.documentElement.classList.add("flatonly");
    el("space").hidden = true;
    el("nowebgl").hidden = false;
  }
  charts.start(
    (stretch) => hasWebGL && scene.choose(stretch),
    (frame) => hasWebGL && scene.mark(frame),
  );
  loops.start((number) => hasWebGL && scene.select(number));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    if (hasWebGL) scene.draw();
    charts.draw();
  });
})();
