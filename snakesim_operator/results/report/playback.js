// Moves the snake over the map: by the slider, by the play button, by an event's button, and by pointing at a chart.
(() => {
  const player = document.querySelector(".player");
  if (!player) return;
  const { frames, captions, joints, end, maps, paths } = JSON.parse(player.querySelector("script").textContent);
  const find = (what) => player.querySelector(what);
  const slider = find("input"), button = find(".play"), speed = find("select"), words = find("output");
  const links = [...player.querySelectorAll(".snake line")], dots = [...player.querySelectorAll(".snake circle")];
  const forces = find(".forces"), perceived = find(".perceived");
  const set = (node, values) => { for (const [key, value] of Object.entries(values)) node.setAttribute(key, value); };

  const arrow = ([x1, y1, x2, y2], kind) => {
    const length = Math.hypot(x2 - x1, y2 - y1);
    if (length < 2) return "";
    const ux = (x2 - x1) / length, uy = (y2 - y1) / length, head = Math.min(kind.startsWith("resultant") ? 14 : 10, length);
    const bx = x2 - ux * head, by = y2 - uy * head, w = 0.38 * head;
    return `<line class="${kind} shaft" x1="${x1}" y1="${y1}" x2="${bx}" y2="${by}"/>`
      + `<polygon class="${kind} head" points="${x2},${y2} ${bx - uy * w},${by + ux * w} ${bx + uy * w},${by - ux * w}"/>`;
  };
  const pieces = (flat) => Array.from({ length: flat.length / 4 }, (_, i) => flat.slice(4 * i, 4 * i + 4));

  let time = frames[0][0], playing = false;
  const show = () => {
    let i = frames.findIndex((frame) => frame[0] > time);
    i = i < 0 ? frames.length - 1 : Math.max(i - 1, 0);
    const [t, nodes, propels, what, solved, measured, map, path, kinds] = frames[i];
    const [later, ahead] = frames[Math.min(i + 1, frames.length - 1)];
    const share = later > t ? Math.min(Math.max((time - t) / (later - t), 0), 1) : 0;
    const at = nodes.map((value, k) => value + share * (ahead[k] - value));
    links.forEach((link, k) => {
      const n = 2 * Math.floor(k / 2);
      set(link, { x1: at[n], y1: at[n + 1], x2: at[n + 2], y2: at[n + 3] });
    });
    dots.forEach((dot, k) => {
      const on = k === propels;
      set(dot, { cx: at[2 * k + 2], cy: at[2 * k + 3], r: on ? 8 : 2.4, class: on ? "propelling" : "joint",
        style: on ? `fill:var(--joint-${k})` : "" });
    });
    perceived.innerHTML = (maps[map] ?? []).map((outline) => `<polygon class="seen" points="${outline}"/>`).join("")
      + (paths[path] ? `<polyline class="planned" points="${paths[path]}"/>` : "");
    forces.innerHTML = pieces(measured).map((one) => arrow(one, "measured")).join("")
      + pieces(solved).map((one, k) => arrow(one, kinds[k])).join("");
    words.innerHTML = `<b>${time.toFixed(2)} s</b> ${propels < 0 ? "" : `<b>${joints[propels]} propels.</b> `}${captions[what]}`;
    slider.value = time;
  };
  const seek = (to) => document.dispatchEvent(new CustomEvent("seek", { detail: to }));
  let mine = false;
  document.addEventListener("seek", ({ detail }) => {
    if (playing && !mine) return;
    time = Math.min(Math.max(detail, 0), end);
    show();
  });
  const play = (on) => {
    playing = on;
    button.textContent = on ? "❚❚ Pause" : "▶ Play";
    if (!on) return;
    if (time >= end - 0.01) time = 0;
    let before = performance.now();
    const step = (now) => {
      if (!playing) return;
      const next = time + (now - before) / 1000 * speed.value;
      before = now;
      mine = true;
      seek(next);
      mine = false;
      if (next >= end) play(false); else requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  };
  set(slider, { min: 0, max: end, step: Math.max(end / 2000, 0.001) });
  speed.value = [1, 4, 16, 64].find((factor) => end / factor <= 40) ?? 64;
  button.addEventListener("click", () => play(!playing));
  slider.addEventListener("input", () => { play(false); seek(+slider.value); });
  for (const jump of document.querySelectorAll("[data-seek]")) {
    jump.addEventListener("click", () => { play(false); seek(+jump.dataset.seek); });
  }
  const LOOKS = ["fill", "fill-opacity", "stroke", "stroke-width", "stroke-dasharray", "stroke-linecap", "font", "display"];
  find(".save").addEventListener("click", () => {
    const drawn = find("svg.figure"), copy = drawn.cloneNode(true), copies = copy.querySelectorAll("*");
    drawn.querySelectorAll("*").forEach((node, i) => {
      const look = getComputedStyle(node);
      copies[i].setAttribute("style", LOOKS.map((name) => `${name}:${look.getPropertyValue(name)}`).join(";"));
    });
    set(copy, { xmlns: "http://www.w3.org/2000/svg", style: `background:${getComputedStyle(player).backgroundColor}` });
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([copy.outerHTML], { type: "image/svg+xml" }));
    link.download = `${document.title} ${time.toFixed(2)} s.svg`;
    link.click();
    URL.revokeObjectURL(link.href);
  });
  seek(time);
})();
