// Charts that follow the colours of the page, and the curves of training.

const SERIES = ["#1f77b4", "#e07b00", "#2ca02c", "#d1495b", "#8b6cc2"];
const PAPER = 640; // the width of a chart on paper, in pixels
const drawings = [];

function ink() {
  return dark.matches && !printing
    ? { text: "#e5e9ef", soft: "#a3adbb", grid: "#323b48" }
    : { text: "#1b2430", soft: "#566173", grid: "#d9dee6" };
}

function axis(settings) {
  const colours = ink();
  return {
    gridcolor: colours.grid, zerolinecolor: colours.grid, linecolor: colours.grid, fixedrange: true, automargin: true,
    ...settings, title: { text: settings.title ?? "", standoff: 8 },
  };
}

// Draw a chart now, and again whenever the colours change. `make` returns traces, layout and a description.
function chart(element, make) {
  const draw = () => {
    const { traces, layout, label } = make();
    const base = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: ink().text, size: 12 },
      margin: { l: 50, r: 12, t: 34, b: 44 }, dragmode: false, hoverlabel: { font: { size: 12 } },
      autosize: !printing, width: printing ? PAPER : undefined,
      legend: { orientation: "h", y: -0.22, font: { size: 11 } },
    };
    Plotly.react(element, traces, { ...base, ...layout }, { displayModeBar: false, responsive: true });
    if (label) element.setAttribute("aria-label", label);
  };
  drawings.push(draw);
  draw();
  return draw;
}

function title(text) {
  return { text, x: 0.01, xanchor: "left", font: { size: 14 } };
}

function drawTraining(element) {
  const { panels, stages } = dataOf(element).curves;
  element.querySelectorAll(".panel").forEach((place, index) => {
    const panel = panels[index];
    chart(place, () => ({
      traces: panel.curves.map((curve, k) => ({
        type: "scatter", mode: curve.x.length < 40 ? "lines+markers" : "lines", name: curve.label, x: curve.x, y: curve.y,
        line: { color: SERIES[k], width: 1.8 }, marker: { size: 4 },
      })),
      layout: {
        title: title(panel.title), showlegend: panel.curves.length > 1,
        xaxis: axis({ title: "update" }),
        yaxis: axis({ type: panel.log ? "log" : "linear", exponentformat: "power", rangemode: panel.log ? "normal" : "tozero" }),
        shapes: stages.map((x) => ({
          type: "line", x0: x, x1: x, y0: 0, y1: 1, yref: "paper", line: { dash: "dot", width: 1, color: ink().soft },
        })),
      },
    }));
  });
}

function redrawAll() {
  drawings.forEach((draw) => draw());
}
