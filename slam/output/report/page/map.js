// SPDX-License-Identifier: Apache-2.0
// What the keyframes saw, put where they were at every stage.
"use strict";

/** Return each stage's points in the world, their numbers and their colours. */
function worldMap() {
  const unit = data.map.unit_m;
  const local = new Int16Array(bytes(data.map.points).buffer);
  const rgb = bytes(data.map.colours);
  const poses = data.keyframes.stages.map(floats); // 3 x 4 of each keyframe
  const stages = poses.map((T) => {
    const world = new Float32Array(local.length);
    let i = 0;
    data.map.keyframes.forEach((keyframe, k) => {
      const at = 12 * keyframe;
      for (let n = 0; n < data.map.counts[k]; n += 1, i += 3) {
        for (let row = 0; row < 3; row += 1) {
          const m = at + 4 * row;
          world[i + row] =
            T[m + 3] + unit * (T[m] * local[i] + T[m + 1] * local[i + 1] + T[m + 2] * local[i + 2]);
        }
      }
    });
    return world;
  });
  const numbers = Array.from({ length: local.length / 3 }, (_, i) => i);
  return {
    stages,
    numbers,
    colours: numbers.map((i) => `rgb(${rgb[3 * i]},${rgb[3 * i + 1]},${rgb[3 * i + 2]})`),
  };
}
