"use strict";
// Draws each plot when it comes near the view, in the colours of the page; a method is shown or hidden in all of them.
(() => {
  const hidden = new Set();
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const LOG_TICKS = "D2"; // at 1, 2 and 5
  const plots = [...document.querySelectorAll(".plot")];
  const config = {
    responsive: true, displaylogo: false, displayModeBar: matchMedia("(hover: hover)").matches ? "hover" : false,
    modeBarButtons: [["toImage"], ["zoom2d", "pan2d", "resetScale2d"]],
  };

  function template() {
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    const axis = {
      automargin: true, gridcolor: colour("--line"), linecolor: colour("--quiet"), tickcolor: colour("--quiet"),
      tickfont: { color: colour("--quiet") }, title: { font: { color: colour("--quiet"), size: 12 }, standoff: 6 },
      zerolinecolor: colour("--zero"), zerolinewidth: 1, nticks: 6, exponentformat: "none",
    };
    const ends = ["#fde725", "#5ec962", "#21918c", "#3b528b", "#440154"]; // viridis: pale is small on white paper
    if (dark.matches && !matchMedia("print").matches) ends.reverse();
    return {
      layout: {
        font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: colour("--ink") },
        paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", xaxis: axis, yaxis: axis,
        hoverlabel: { bgcolor: colour("--paper"), bordercolor: colour("--quiet"), font: { color: colour("--ink") } },
        modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("--quiet"), activecolor: colour("--ink") },
        coloraxis: {
          colorscale: ends.map((end, i) => [i / (ends.length - 1), end]),
          colorbar: { outlinewidth: 0, tickfont: { color: colour("--quiet") } },
        },
      },
    };
  }

  const isShown = (trace) => !hidden.has(trace.legendgroup);

  function draw(plot) {
    if (plot.dataset.drawn) return;
    plot.dataset.drawn = "1";
    const figure = JSON.parse(plot.querySelector("script").textContent);
    for (const trace of figure.data) trace.visible = isShown(trace);
    const layout = {
      margin: { l: 8, r: 8, t: 6, b: 8 }, showlegend: false, dragmode: "zoom", ...figure.layout, template: template(),
    };
    if (layout.yaxis?.type === "log") layout.yaxis.dtick = LOG_TICKS;
    Plotly.newPlot(plot, figure.data, layout, config);
  }

  const drawn = () => plots.filter((plot) => plot.dataset.drawn);
  const drawAll = () => plots.forEach(draw);
  const restyle = (plot) => Plotly.restyle(plot, { visible: plot.data.map(isShown) });

  function showMethods() {
    drawn().forEach(restyle);
    for (const button of document.querySelectorAll(".legend button")) {
      button.setAttribute("aria-pressed", String(!hidden.has(button.dataset.key)));
    }
  }

  document.addEventListener("click", (event) => {
    const entry = event.target.closest(".legend button"), scale = event.target.closest("button.log");
    if (entry && event.detail < 2) {
      if (!hidden.delete(entry.dataset.key)) hidden.add(entry.dataset.key);
      showMethods();
    }
    if (scale) {
      const log = scale.getAttribute("aria-pressed") !== "true";
      scale.setAttribute("aria-pressed", String(log));
      const plot = scale.closest(".panel").querySelector(".plot");
      draw(plot);
      const axis = { "yaxis.type": log ? "log" : "linear", "yaxis.dtick": log ? LOG_TICKS : null };
      Plotly.relayout(plot, { ...axis, "yaxis.autorange": true });
    }
  });

  document.addEventListener("dblclick", (event) => {
    const entry = event.target.closest(".legend button");
    if (!entry) return;
    const others = [...entry.closest(".legend").querySelectorAll("button")].map((button) => button.dataset.key);
    const alone = others.every((key) => key === entry.dataset.key || hidden.has(key));
    hidden.clear();
    if (!alone) others.filter((key) => key !== entry.dataset.key).forEach((key) => hidden.add(key));
    showMethods();
  });

  const recolour = () => drawn().forEach((plot) => Plotly.relayout(plot, { template: template() }));
  dark.addEventListener("change", recolour);
  matchMedia("print").addEventListener("change", recolour); // paper is light whatever the screen is
  // On paper plots are as wide as the page, not as the window, and folded tables are shown.
  addEventListener("beforeprint", () => {
    document.documentElement.classList.add("printing");
    document.querySelectorAll("details.table:not([open])").forEach((table) => table.toggleAttribute("open"));
    drawAll();
    for (const plot of plots) Plotly.relayout(plot, { width: plot.clientWidth, height: plot.clientHeight });
  });
  addEventListener("afterprint", () => {
    document.documentElement.classList.remove("printing");
    for (const plot of plots) {
      delete plot.layout.width;
      delete plot.layout.height;
      Plotly.Plots.resize(plot); // which leaves plots of a given size alone
    }
  });
  const observer = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) draw(entry.target);
  }, { rootMargin: "800px" });
  plots.forEach((plot) => observer.observe(plot));
})();
