// Signals over time: searched, put beside each other, under one cursor, within ranges, and saved as they are seen.
(() => {
  const at = (id) => document.getElementById(id);
  const root = document.documentElement, within = parent !== window;
  const MOST_FOUND = 60, PLOT_PX = 190, EVERY_MS = 500, EDGE = 12, WIDE = 54;
  let units = {}, recorded = true, plots = [], chosen = null, span = null, now = null, pointed = null;

  const element = (tag, given = {}, ...inside) => {
    const made = Object.assign(document.createElement(tag), given);
    made.append(...inside);
    return made;
  };
  const showNotice = (words, bad = false) => { at("notice").textContent = words; at("notice").className = bad ? "bad" : ""; };
  const ask = async (path, given = [], headers = {}) => {
    const answer = await fetch(`signals/${path}?${new URLSearchParams(given)}`, { cache: "no-store", headers });
    if (!answer.ok) throw new Error(await answer.text());
    return answer;
  };
  const shown = (value) => value === null || value === undefined ? "–" : String(Number(value.toPrecision(4)));
  const color = (name) => getComputedStyle(root).getPropertyValue(name).trim();
  const literal = (text) => text.replace(/[&<>]/g, (sign) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;" })[sign]);
  const window_ = () => span === null ? [] : [["from_s", span[0]], ["to_s", span[1]]];
  const every = (plot) => [...plot.sides[0].names, ...plot.sides[1].names];

  // --- which signals ---
  const search = () => {
    const words = at("search").value.toLowerCase().split(/\s+/).filter(Boolean);
    const names = Object.keys(units).filter((name) => words.every((word) => `${name} ${units[name]}`.toLowerCase().includes(word)));
    at("found").replaceChildren(...(words.length ? names.slice(0, MOST_FOUND) : []).map((name) => {
      const line = element("li", {}, element("button", { textContent: `${name}, ${units[name]}`, onclick: () => open(name) }));
      if (chosen) line.append(element("button", { textContent: "beside", title: "in the plot with the blue frame", onclick: () => beside(name) }));
      return line;
    }));
    showNotice(words.length ? `${names.length} of ${Object.keys(units).length} signals` : `${Object.keys(units).length} signals`);
  };
  const suits = (unit, other) => unit === other || unit.split(/, | or /).includes(other) || other.split(/, | or /).includes(unit);

  const open = (name) => {
    const plot = { sides: [{ names: [], range: null }, { names: [], range: null }], data: {}, box: element("section") };
    plot.view = element("div", { className: "plot" });
    plot.cursor = element("div", { className: "cursor" });
    plot.table = element("table");
    plot.ranges = element("div", { className: "ranges" });
    plot.box.append(plot.view, plot.cursor, plot.table, plot.ranges);
    plot.box.addEventListener("pointerdown", () => choose(plot));
    plots.push(plot);
    at("plots").append(plot.box);
    choose(plot);
    follow(plot);
    beside(name);
    search();
  };
  const beside = (name) => {
    const [left, right] = chosen.sides, unit = units[name];
    if (every(chosen).includes(name)) return;
    const side = [left, right].find((one) => !one.names.length || suits(units[one.names[0]], unit));
    if (!side) return showNotice(`${units[left.names[0]]} and ${units[right.names[0]]} have both axes: put ${name} into a plot of its own`, true);
    side.names.push(name);
    remember();
    load(chosen);
  };
  const leave = (plot, name) => {
    for (const side of plot.sides) side.names = side.names.filter((one) => one !== name);
    if (!plot.sides[0].names.length) plot.sides.reverse();
    if (every(plot).length) load(plot);
    else {
      plots = plots.filter((one) => one !== plot);
      plot.box.remove();
      choose(plots.at(-1) ?? null);
    }
    remember();
  };
  const choose = (plot) => {
    chosen = plot;
    for (const one of plots) one.box.classList.toggle("chosen", one === plot);
  };
  const remember = () => history.replaceState(null, "", "#" + plots.map((plot) => every(plot).join(",")).join(";"));

  // --- drawing ---
  const load = async (plot) => {
    const names = every(plot), listed = names.join();
    if (plot.listed !== listed) { // its fields stay as they are while new values come
      plot.listed = listed;
      plot.table.replaceChildren(...rows(plot));
      plot.ranges.replaceChildren(...plot.sides.filter((side) => side.names.length).map((side) => limits(plot, side)));
    }
    try {
      plot.data = await (await ask("values", [...names.map((name) => ["name", name]), ...window_()])).json();
    } catch (error) {
      return showNotice(`no values: ${error.message}`, true);
    }
    draw(plot);
  };
  const figure = (plot) => {
    const small = { size: 11.5, color: color("--soft") };
    const axis = { gridcolor: color("--grid"), linecolor: color("--faint"), zerolinecolor: color("--rule"), tickfont: small };
    const names = every(plot).filter((name) => plot.data[name]);
    const known = names.flatMap((name) => plot.data[name].time_s);
    const layout = {
      height: PLOT_PX, margin: { l: WIDE, r: plots.some((one) => one.sides[1].names.length) ? WIDE : EDGE, t: 8, b: 34 }, showlegend: false, hovermode: false,
      dragmode: "zoom", paper_bgcolor: color("--card"), plot_bgcolor: color("--card"), font: { size: 12, color: color("--ink") },
      xaxis: { ...axis, title: { text: "time, s", font: small, standoff: 4 }, range: span ?? [known.reduce((a, b) => Math.min(a, b), Infinity), known.reduce((a, b) => Math.max(a, b), -Infinity)] },
    };
    plot.sides.forEach((side, i) => {
      if (!side.names.length) return;
      const fixed = side.range ? { range: side.range, autorange: false } : { autorange: true };
      layout[i ? "yaxis2" : "yaxis"] = { ...axis, ...fixed, fixedrange: true, title: { text: literal(units[side.names[0]] ?? ""), font: small, standoff: 4 }, ...(i ? { overlaying: "y", side: "right", tickmode: "auto", showgrid: false } : {}) };
    });
    const traces = names.map((name) => ({
      type: "scatter", mode: "lines", name: literal(`${name}, ${units[name]}`), x: plot.data[name].time_s, y: plot.data[name].values,
      yaxis: plot.sides[1].names.includes(name) ? "y2" : "y",
      line: { color: color(look(plot, name)), width: 1.5, dash: plot.sides[1].names.includes(name) ? "dash" : "solid" },
    }));
    return [traces, layout];
  };
  const look = (plot, name) => `--joint-${every(plot).indexOf(name) % 8}`;
  const draw = async (plot) => {
    await Plotly.react(plot.view, ...figure(plot), { responsive: true, displayModeBar: false, doubleClick: false });
    place();
  };
  const rows = (plot) => [
    element("tr", {}, ...["", "", "min", "mean", "max", ""].map((words) => element("th", { textContent: words }))),
    ...every(plot).map((name) => element("tr", {},
      element("td", {}, element("span", { textContent: "■\u00a0", style: `color:var(${look(plot, name)})` }), `${name}, ${units[name]}`),
      ...Array.from({ length: 4 }, () => element("td")),
      element("td", {}, element("button", { textContent: "×", title: `take ${name} away`, onclick: () => leave(plot, name) })))),
  ];
  const limits = (plot, side) => {
    const put = (which) => element("input", {
      type: "text", inputMode: "decimal", placeholder: "auto", value: side.range?.[which] ?? "",
      ariaLabel: `${which ? "highest" : "lowest"} ${units[side.names[0]]}`,
    });
    const low = put(0), high = put(1);
    const change = () => {
      const values = [low, high].map((field) => field.value.trim() === "" ? null : Number(field.value));
      if (values.some((value) => Number.isNaN(value)) || (values[0] !== null && values[1] !== null && values[0] >= values[1])) {
        return showNotice("a range has its lower number first, or is empty", true);
      }
      side.range = values.every((value) => value === null) ? null : values;
      draw(plot);
    };
    low.onchange = high.onchange = change;
    return element("span", {}, `${units[side.names[0]]} from `, low, " to ", high);
  };

  // --- one cursor, one stretch of time ---
  const near = ({ time_s: times, values }, time) => {
    let low = 0, high = times.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (times[middle] <= time + 1e-9) low = middle; else high = middle - 1;
    }
    return times.length && times[0] <= time + 1e-9 ? values[low] : null;
  };
  const place = () => {
    const time = pointed ?? now;
    for (const plot of plots) {
      const { xaxis, _size: size } = plot.view._fullLayout ?? {};
      if (!xaxis) continue;
      const x = time === null ? -1 : xaxis.d2p(time), inside = x >= 0 && x <= size.w;
      Object.assign(plot.cursor.style, { display: inside ? "block" : "none", left: `${plot.view.offsetLeft + size.l + x}px`, top: `${plot.view.offsetTop + size.t}px`, height: `${size.h}px` });
      plot.table.rows[0].cells[1].textContent = time === null ? "at cursor" : `at ${time.toFixed(2)} s`;
      every(plot).forEach((name, i) => {
        const data = plot.data[name], [min, mean, max] = data?.range ?? [];
        [data && time !== null ? near(data, time) : null, min, mean, max].forEach((value, k) => {
          plot.table.rows[i + 1].cells[k + 1].textContent = shown(value);
        });
      });
    }
  };
  const follow = (plot) => {
    const time = (event) => {
      const { xaxis, _size: size } = plot.view._fullLayout, x = event.clientX - plot.view.getBoundingClientRect().left - size.l;
      return x >= 0 && x <= size.w ? xaxis.p2d(x) : null;
    };
    let pressed = null;
    plot.view.addEventListener("pointermove", (event) => { pointed = time(event); place(); });
    plot.view.addEventListener("pointerleave", () => { pointed = null; place(); });
    plot.view.addEventListener("pointerdown", (event) => { pressed = event.clientX; }, true);
    addEventListener("pointerup", (event) => {
      const still = pressed !== null && Math.abs(event.clientX - pressed) < 4, there = still ? time(event) : null;
      pressed = null;
      if (there !== null && recorded) ask("go", [["time_s", there]], { "X-Snakesim": "go" }).catch((error) => showNotice(error.message, true));
    }, true);
    Plotly.newPlot(plot.view, [], { height: PLOT_PX }, { responsive: true, displayModeBar: false, doubleClick: false });
    plot.view.on("plotly_relayout", (change) => {
      if (change["xaxis.range[0]"] === undefined) return;
      show([change["xaxis.range[0]"], change["xaxis.range[1]"]]);
    });
  };
  const show = (stretch) => { span = stretch; plots.forEach(load); };
  at("all").onclick = () => show(null);

  // --- saving what is seen ---
  const save = (blob, name) => {
    const link = element("a", { href: URL.createObjectURL(blob), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    showNotice(`saved: ${name}`);
  };
  const picture = async () => {
    const width = plots[0].view.clientWidth, height = PLOT_PX + 22 * Math.max(...plots.map((plot) => every(plot).length));
    const parts = await Promise.all(plots.map(async (plot, i) => {
      const [data, layout] = figure(plot), rows = 22 * every(plot).length;
      const whole = { ...layout, height, showlegend: true, legend: { orientation: "v", x: 0, y: 1, yanchor: "bottom" }, margin: { ...layout.margin, t: rows + 8 } };
      const address = await Plotly.toImage({ data, layout: whole }, { format: "svg", width, height });
      return decodeURIComponent(address.slice(address.indexOf(",") + 1)).replace("<svg", `<svg y="${i * height}"`);
    }));
    const size = `width="${width}" height="${parts.length * height}"`;
    return [`<svg xmlns="http://www.w3.org/2000/svg" ${size}>${parts.join("")}</svg>`, width, parts.length * height];
  };
  const saving = (act) => async () => {
    if (!plots.length) return showNotice("nothing is drawn yet: search a signal first", true);
    try { await act(); } catch (error) { showNotice(`not saved: ${error.message}`, true); }
  };
  at("csv").onclick = saving(async () => {
    const names = [...new Set(plots.flatMap(every))].map((name) => ["name", name]);
    save(await (await ask("values.csv", [...names, ...window_()])).blob(), "signals.csv");
  });
  at("svg").onclick = saving(async () => save(new Blob([(await picture())[0]], { type: "image/svg+xml" }), "signals.svg"));
  at("png").onclick = saving(async () => {
    const [text, width, height] = await picture(), image = new Image();
    image.src = `data:image/svg+xml,${encodeURIComponent(text)}`;
    await image.decode();
    const canvas = element("canvas", { width: 2 * width, height: 2 * height });
    canvas.getContext("2d").drawImage(image, 0, 0, 2 * width, 2 * height);
    save(await new Promise((done) => canvas.toBlob(done)), "signals.png");
  });

  // --- with the console around it ---
  const dress = () => {
    const dark = within ? parent.document.documentElement.dataset.mantineColorScheme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    if (root.classList.toggle("dark", dark) !== null) plots.forEach(draw);
  };
  if (within) {
    new MutationObserver(dress).observe(parent.document.documentElement, { attributes: true, attributeFilter: ["data-mantine-color-scheme"] });
    addEventListener("keydown", (event) => { // the console's keys, above all that of the stop
      if (event.target.closest?.("input")) return;
      parent.document.body.dispatchEvent(new parent.KeyboardEvent("keydown", { key: event.key, code: event.code, repeat: event.repeat, bubbles: true, cancelable: true }));
    });
  } else matchMedia("(prefers-color-scheme: dark)").addEventListener("change", dress);
  addEventListener("resize", () => setTimeout(place, 200));
  at("search").oninput = search;

  const turn = async () => {
    try {
      if (root.clientWidth) { // not in a tab that is closed
        const before = Object.keys(units).length;
        if (!before || !recorded) ({ recorded, units } = await (await ask("names")).json());
        if (Object.keys(units).length !== before) { search(); if (!before) location.hash && restore(); }
        now = (await (await ask("now")).json()).time_s;
        if (!recorded && span === null) await Promise.all(plots.map(load));
        place();
      }
    } catch (error) { showNotice("the console does not answer", true); }
    setTimeout(turn, EVERY_MS);
  };
  const restore = () => {
    for (const names of decodeURIComponent(location.hash.slice(1)).split(";")) {
      const known = names.split(",").filter((name) => name in units);
      if (known.length) { open(known[0]); known.slice(1).forEach(beside); }
    }
  };
  dress();
  turn();
})();
