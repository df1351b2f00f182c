// One time cursor through all charts: point at one, and see the same instant in every other. The page works without.
(() => {
  const charts = [...document.querySelectorAll("svg[data-end-s]")];
  const make = (name) => document.createElementNS("http://www.w3.org/2000/svg", name);
  const marks = charts.map((chart) => {
    const line = make("line"), label = make("text");
    line.setAttribute("class", "cursor");
    label.setAttribute("class", "small soft halo cursor-time");
    for (const mark of [line, label]) { mark.style.display = "none"; chart.append(mark); }
    return { line, label };
  });
  const show = (time) => charts.forEach((chart, i) => {
    const { left, right, top, bottom, beginS, endS } = chart.dataset;
    const { line, label } = marks[i];
    const outside = time === null || time < beginS || time > +endS;
    const hidden = outside ? "none" : "";
    line.style.display = label.style.display = hidden;
    if (outside) return;
    const x = +left + (right - left) * (time - beginS) / (endS - beginS);
    for (const end of ["x1", "x2"]) line.setAttribute(end, x);
    line.setAttribute("y1", top);
    line.setAttribute("y2", bottom);
    const late = x > 0.85 * right;
    label.setAttribute("x", x + (late ? -4 : 4));
    label.setAttribute("y", bottom - 5);
    label.setAttribute("text-anchor", late ? "end" : "start");
    label.textContent = `${time.toFixed(2)} s`;
  });
  charts.forEach((chart) => {
    chart.addEventListener("pointermove", (event) => {
      const box = chart.getBoundingClientRect(), { left, right, beginS, endS } = chart.dataset;
      const x = (event.clientX - box.left) * chart.viewBox.baseVal.width / box.width;
      const time = +beginS + (x - left) / (right - left) * (endS - beginS);
      show(time >= beginS && time <= +endS ? time : null);
    });
    chart.addEventListener("pointerleave", () => show(null));
  });
})();
