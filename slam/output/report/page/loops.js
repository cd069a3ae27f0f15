// SPDX-License-Identifier: Apache-2.0
// The list of loop candidates, and the one that is looked at: its images, matches and numbers.
"use strict";

const loops = (() => {
  const body = document.querySelector("#loops tbody");
  const rows = body ? [...body.rows] : [];
  const listeners = [];
  let chosen = -1;

  const seconds = (keyframe) => floats(data.keyframes.times_s)[keyframe].toFixed(1);

  function create(name, attributes) {
    const element = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    return element;
  }

  /** Draw both views side by side, the earlier left, and the matches over them. */
  function drawViews() {
    const loop = data.loops[chosen];
    const views = el("views");
    const images = loop.pair.map((keyframe) => data.pictures[keyframe]);
    const height = 3000 / data.aspect; // a view is 3000 wide, so that lines have whole numbers
    views.setAttribute("viewBox", `0 0 6000 ${height}`);
    views.setAttribute(
      "aria-label",
      `Keyframes ${loop.pair.join(" and ")} side by side, with ${loop.agreeing} matches that agree`,
    );
    views.replaceChildren();
    views.toggleAttribute("hidden", !images.some(Boolean));
    el("nopicture").hidden = images.every(Boolean);
    el("nopicture").textContent = Object.keys(data.pictures).length
      ? "No picture: this page has room for those of the most doubtful candidates alone."
      : "No picture: the run has kept none.";
    images.forEach((href, side) => {
      if (href) views.append(create("image", { href, x: 3000 * side, y: 0, width: 3000, height }));
    });
    const ends = new Uint16Array(bytes(loop.matches).buffer);
    const draw = (from, to, tint, opacity) => {
      for (let i = 4 * from; i < 4 * to; i += 4) {
        const [x1, x2] = [(ends[i] / 65535) * 3000, 3000 + (ends[i + 2] / 65535) * 3000];
        const [y1, y2] = [(ends[i + 1] / 65535) * height, (ends[i + 3] / 65535) * height];
        const style = `stroke:var(--${tint})`;
        views.append(create("line", { x1, y1, x2, y2, style, "stroke-width": 1, opacity }));
        for (const [cx, cy] of [
          [x1, y1],
          [x2, y2],
        ])
          views.append(create("circle", { cx, cy, r: 22, style: `fill:var(--${tint})` }));
      }
    };
    if (el("others").checked) draw(loop.agreeing, ends.length / 4, "differ", 0.5);
    if (el("agreeing").checked) draw(0, loop.agreeing, "agree", 0.55);
  }

  function tell() {
    const loop = data.loops[chosen];
    const [, , similarity, inliers] = [...rows[chosen].cells].map((cell) =>
      cell.textContent.trim(),
    );
    const [outcome, why] = ["label", "why"].map(
      (name) => rows[chosen].querySelector(`.${name}`).textContent,
    );
    const [match, query] = loop.pair;
    el("pairname").textContent = `Keyframes ${match} and ${query}`;
    const facts = [
      ["Outcome", outcome],
      ["Why", why],
      ["Similarity", similarity],
      ["Matches that agree", inliers],
      ["Taken", `${seconds(match)} s and ${seconds(query)} s`],
    ];
    if (loop.motion) facts.push(["Motion", loop.motion]);
    if (loop.left_out) facts.push(["Left out", loop.left_out]);
    el("numbers").replaceChildren(
      ...facts.flatMap(([name, value]) => {
        const [term, text] = [document.createElement("dt"), document.createElement("dd")];
        term.textContent = name;
        text.textContent = value;
        return [term, text];
      }),
    );
  }

  function select(number, isQuiet) {
    if (!rows[number]) return;
    rows[chosen]?.removeAttribute("aria-current");
    chosen = number;
    rows[chosen].setAttribute("aria-current", "true");
    drawViews();
    tell();
    for (const listener of listeners) listener(chosen);
    if (isQuiet) return;
    const list = document.querySelector(".list");
    const top = rows[chosen].offsetTop - list.clientHeight / 2;
    if (!rows[chosen].contains(document.activeElement)) list.scrollTop = top;
    const box = el("inspect").getBoundingClientRect();
    if (box.bottom < 80 || box.top > innerHeight - 80)
      el("inspect").scrollIntoView({ block: "center" });
  }

  function step(by) {
    const visible = [...body.rows].filter((row) => !row.hidden);
    const next =
      visible[visible.indexOf(rows[chosen]) + by] || (by > 0 ? visible[0] : visible.at(-1));
    if (next) select(rows.indexOf(next));
  }

  function filter() {
    const kind = el("filter").value;
    for (const row of rows)
      row.hidden = kind !== "" && !row.classList.contains(kind === "?" ? "doubtful" : kind);
  }

  function sort() {
    const key = el("order").value;
    const value = (row) => Number(row.dataset[key]) || 0;
    body.append(...(key ? [...rows].sort((a, b) => value(b) - value(a)) : rows));
  }

  function start(onSelect) {
    if (!rows.length) return;
    rows.forEach((row, number) => row.addEventListener("click", () => select(number)));
    el("previous").addEventListener("click", () => step(-1));
    el("next").addEventListener("click", () => step(1));
    for (const id of ["agreeing", "others"]) el(id).addEventListener("change", drawViews);
    el("filter").addEventListener("change", filter);
    el("order").addEventListener("change", sort);
    select(0, true);
    listeners.push(onSelect);
    onSelect(0);
  }

  return { start, select };
})();
