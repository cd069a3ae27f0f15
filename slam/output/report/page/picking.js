// SPDX-License-Identifier: Apache-2.0
// Which line in space was clicked: Plotly tells points alone, and those in front hide others.
"use strict";

const picking = (() => {
  const NEAR_PX = 12;

  /** Return the function that takes a point in space to the screen. */
  function projection(div) {
    const { glplot, dataScale } = div._fullLayout.scene._scene;
    const { model, view, projection: lens } = glplot.cameraParams;
    const box = glplot.canvas.getBoundingClientRect();
    const times = (p, m) =>
      [0, 1, 2, 3].map((i) => p.reduce((sum, x, j) => sum + m[4 * j + i] * x, 0));
    return (point) => {
      const scaled = [...point.map((x, i) => x * dataScale[i]), 1];
      const [x, y, , w] = [model, view, lens].reduce(times, scaled);
      return [box.x + (box.width * (1 + x / w)) / 2, box.y + (box.height * (1 - y / w)) / 2];
    };
  }

  function distance([x, y], [ax, ay], [bx, by]) {
    const [dx, dy] = [bx - ax, by - ay];
    const share = Math.min(
      1,
      Math.max(0, ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1)),
    );
    return Math.hypot(x - ax - share * dx, y - ay - share * dy);
  }

  /** Call back with the key of the line nearest to each click; `lines` gives [key, end, end]. */
  function onClick(div, lines, callback) {
    let pressed = null;
    div.addEventListener(
      "pointerdown",
      (event) => {
        pressed = [event.clientX, event.clientY];
      },
      true,
    );
    div.addEventListener(
      "pointerup",
      (event) => {
        const at = [event.clientX, event.clientY];
        if (!pressed || distance(at, pressed, pressed) > 4) return; // the view was turned
        const toScreen = projection(div);
        let [nearest, least] = [null, NEAR_PX];
        for (const [key, ...ends] of lines()) {
          const far = distance(at, ...ends.map(toScreen));
          if (far < least) [nearest, least] = [key, far];
        }
        if (nearest !== null) callback(nearest);
      },
      true,
    );
  }

  return { onClick, projection };
})();
