// Draws every chart of the page in the colors of the theme. One time cursor and one zoom go through all of them.
(() => {
  const charts = [...document.querySelectorAll(".chart")];
  const theme = matchMedia("(prefers-color-scheme: dark)");
  const touch = matchMedia("(pointer: coarse)").matches;
  const look = getComputedStyle(document.documentElement);

  const colored = (value) => {
    if (typeof value === "string") return value.startsWith("--") ? look.getPropertyValue(value).trim() : value;
    if (Array.isArray(value)) return value.map(colored);
    if (value === null || typeof value !== "object") return value;
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, colored(item)]));
  };
  const axis = {
    gridcolor: "--grid", zerolinecolor: "--rule", linecolor: "--faint", tickcolor: "--faint", zerolinewidth: 1,
  };
  const small = { size: 11.5, color: "--soft" };
  const base = {
    autosize: true, dragmode: touch ? false : "zoom", margin: { l: 70, r: 14, t: 26, b: 40 },
    paper_bgcolor: "--card", plot_bgcolor: "--card",
    font: { family: "system-ui, -apple-system, 'Segoe UI', Roboto, Arial, sans-serif", size: 12, color: "--ink" },
    legend: { orientation: "h", x: 0, y: 1, xanchor: "left", yanchor: "bottom", font: small, bgcolor: "rgba(0,0,0,0)" },
    hoverlabel: { bgcolor: "--page", bordercolor: "--rule", font: { color: "--ink", size: 12 }, namelength: -1 },
    modebar: { bgcolor: "rgba(0,0,0,0)", color: "--faint", activecolor: "--ink" },
  };
  const save = (format) => (node) => Plotly.downloadImage(node, {
    format, filename: node.parentElement.ariaLabel, width: node.clientWidth, height: node.clientHeight, scale: 2,
  });
  const config = {
    responsive: true, displaylogo: false, displayModeBar: touch || "hover", doubleClick: "reset", showTips: false,
    modeBarButtons: [[
      "zoom2d", "resetScale2d",
      { name: "Save as PNG", icon: Plotly.Icons.camera, click: save("png") },
      { name: "Save as SVG", icon: Plotly.Icons.disk, click: save("svg") },
    ]],
  };

  const draw = (chart) => {
    const figure = JSON.parse(chart.querySelector("script").textContent);
    const { xaxis, yaxis, annotations } = figure.layout;
    const layout = {
      ...base, ...figure.layout,
      annotations: annotations.map((note) => ({ font: small, ...note })),
      xaxis: { ...axis, unifiedhovertitle: { text: "%{x:.2f} s" }, ...xaxis, title: { ...xaxis.title, font: small, standoff: 6 } },
      yaxis: { ...axis, fixedrange: true, hoverformat: ".4g", automargin: yaxis.type === "category", ...yaxis,
        title: { ...yaxis.title, font: small, standoff: 6 } },
    };
    return Plotly.react(chart.querySelector(".plot"), colored(figure.data), colored(layout), config);
  };

  const seek = (time) => document.dispatchEvent(new CustomEvent("seek", { detail: time }));
  let zooming = false;
  for (const chart of charts) {
    const plot = chart.querySelector(".plot");
    draw(chart);
    plot.on("plotly_relayout", (change) => {
      if (zooming || !Object.keys(change).some((key) => key.startsWith("xaxis"))) return;
      zooming = true;
      const range = [...plot.layout.xaxis.range];
      const others = charts.filter((one) => one !== chart).map((one) => one.querySelector(".plot"));
      Promise.all(others.map((one) => Plotly.relayout(one, { "xaxis.range": [...range] }))).finally(() => {
        zooming = false;
        document.dispatchEvent(new CustomEvent("zoomed"));
      });
    });
    chart.addEventListener("pointermove", (event) => {
      const { xaxis, _size: size } = plot._fullLayout;
      const x = event.clientX - plot.getBoundingClientRect().left - size.l;
      if (x >= 0 && x <= size.w) seek(xaxis.p2d(x));
    });
  }

  let now = null;
  const place = () => charts.forEach((chart) => {
    const { xaxis, _size: size } = chart.querySelector(".plot")._fullLayout;
    const cursor = chart.querySelector(".cursor");
    const x = now === null ? -1 : xaxis.d2p(now);
    cursor.style.display = x < 0 || x > size.w ? "none" : "block";
    Object.assign(cursor.style, { left: `${size.l + x}px`, top: `${size.t}px`, height: `${size.h}px` });
  });
  document.addEventListener("seek", ({ detail }) => { now = detail; place(); });
  document.addEventListener("zoomed", place);
  addEventListener("resize", () => setTimeout(place, 200));
  const redraw = () => charts.forEach(draw);
  theme.addEventListener("change", redraw);
  addEventListener("beforeprint", () => { document.documentElement.classList.add("paper"); redraw(); });
  addEventListener("afterprint", () => { document.documentElement.classList.remove("paper"); redraw(); });
})();
