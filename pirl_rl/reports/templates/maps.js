// Heat maps of V and of the control, with lines of constant V, the outlines of both sets, and paths.

const TARGET = "#39d353", AVOID = "#ff4d3d";
const STARTS = ["#ffffff", "#ffa31a", "#4cc3ff"];
const ENDS = { reached: "circle-open", failed: "x-thin-open", over: "square-open" };
const CONTROL = [[0, "#3b4cc0"], [0.25, "#8db0fe"], [0.5, "#dddddd"], [0.75, "#f49a7b"], [1, "#b40426"]];

function heat(x, y, z, low, high, colours, name) {
  return {
    type: "heatmap", x, y, z, zmin: low, zmax: high, colorscale: colours, zsmooth: "fast", hoverongaps: false,
    hovertemplate: `%{x:.3g}, %{y:.3g}: ${name} = %{z:.3f}<extra></extra>`,
    colorbar: { thickness: 10, outlinewidth: 0, tickfont: { size: 10 }, x: 1.01 },
  };
}

function lines(x, y, z, colour) {
  return {
    type: "contour", x, y, z, showscale: false, hoverinfo: "skip", line: { color: colour, width: 1 },
    contours: { coloring: "none", start: 0.1, end: 0.9, size: 0.2 }, // labels would take most of the time of a drawing
  };
}

function outline(x, y, levels, colour) {
  return {
    type: "contour", x, y, z: levels, showscale: false, hoverinfo: "skip", line: { color: colour, width: 2.5, smoothing: 0 },
    contours: { coloring: "none", start: 0, end: 0, size: 1 },
  };
}

// Lines, ends and present places of paths. `at` maps a point of a path, and its time to go, to a place on the chart.
function pathTraces(paths, points, tau, at, seams) {
  const each = points.length / paths.starts.length;
  const traces = STARTS.map((colour) => ({
    type: "scatter", mode: "lines", x: [], y: [], line: { color: colour, width: 1.3 }, hoverinfo: "skip",
  }));
  const ends = { type: "scatter", mode: "markers", x: [], y: [], hoverinfo: "skip", marker: { symbol: [], size: 9, color: [], line: { width: 2 } } };
  const now = { type: "scatter", mode: "markers", x: [], y: [], hoverinfo: "skip", marker: { size: 9, color: [], line: { width: 1.5, color: "#10151c" } } };
  const present = paths.tau.findIndex((value) => value <= tau * (1 + 1e-9));
  points.forEach((path, i) => {
    const last = paths.steps[i], colour = STARTS[Math.floor(i / each)], trace = traces[Math.floor(i / each)];
    let before = null;
    for (let k = 0; k <= last; k++) {
      const place = at(path[k], paths.tau[k]);
      if (before && seams.some((width, j) => width && Math.abs(place[j] - before[j]) > width / 2)) { trace.x.push(null); trace.y.push(null); }
      trace.x.push(place[0]); trace.y.push(place[1]);
      before = place;
    }
    trace.x.push(null); trace.y.push(null);
    ends.x.push(before[0]); ends.y.push(before[1]); ends.marker.symbol.push(ENDS[paths.ends[i]]); ends.marker.color.push(colour);
    const k = Math.min(present < 0 ? last : present, last), place = at(path[k], paths.tau[k]);
    now.x.push(place[0]); now.y.push(place[1]); now.marker.color.push(colour);
  });
  return [...traces, ends, now];
}
