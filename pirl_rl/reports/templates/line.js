// Problems with one state: curves of V and of the control over the state, and maps of both over the time to go.

async function exploreLine(root) {
  const data = dataOf(root), line = data.line, find = (name) => root.querySelector(name), count = line.points;
  const x = Array.from({ length: count }, (_, i) => line.low + (line.high - line.low) * i / (count - 1));
  const state = { tau: line.start, component: 0 };
  const curves = {};
  for (const [name, text] of Object.entries(line.curves)) curves[name] = await unpacked(text, 2);
  const actions = await Promise.all(line.control.map((text) => unpacked(text, 2)));
  const probability = (code) => code / 65535;
  const control = () => data.controls[state.component];
  const action = (code) => control().low + (control().high - control().low) * code / 65535;
  const row = (codes, t, turn) => Array.from(codes.subarray(t * count, (t + 1) * count), turn);
  const columns = (codes, turn) => x.map((_, i) => line.taus.map((_, t) => turn(codes[t * count + i])));
  const unit = () => (control().unit ? ` (${control().unit})` : "");

  const NAMES = { value: "V", exact: "exact V", lower: "proved of the policy, from below", upper: "proved of all policies, from above" };
  const DASHES = { value: "solid", exact: "dash", lower: "dot", upper: "dot" };
  const curve = (codes, turn, name, dash, colour) => ({
    type: "scatter", mode: "lines", x, y: row(codes, state.tau, turn), name, line: { dash, color: colour, width: 2 },
    hovertemplate: "%{x:.3g}: %{y:.4f}",
  });
  const curveLayout = (text, range) => ({
    title: title(text), xaxis: axis({ title: line.label, range: [line.low, line.high] }), yaxis: axis({ range }), hovermode: "x unified",
  });
  const map = (z, low, high, colours, name, text, colour) => ({
    traces: [
      heat(line.taus, x, z, low, high, colours, name), lines(line.taus, x, columns(curves.value, probability), colour),
      ...(find(".with-paths").checked ? pathTraces(data.paths, data.paths.points[0], line.taus[state.tau], (point, tau) => [tau, point[0]], [0, line.periodic ? line.high - line.low : 0]) : []),
    ],
    layout: {
      title: title(text), showlegend: false, margin: { l: 52, r: 8, t: 34, b: 46 },
      xaxis: axis({ title: "time to go τ (s)", range: [0, data.horizon] }), yaxis: axis({ title: line.label, range: [line.low, line.high] }),
      shapes: [{ type: "line", x0: line.taus[state.tau], x1: line.taus[state.tau], y0: 0, y1: 1, yref: "paper", line: { width: 1.5, dash: "dot", color: "#ffffff" } }],
    },
  });
  const time = () => `${short(line.taus[state.tau])} s`;

  const redraws = [
    chart(find(".curve-value"), () => ({
      traces: Object.keys(NAMES).filter((name) => name in curves).map((name, k) => curve(curves[name], probability, NAMES[name], DASHES[name], SERIES[k])),
      layout: curveLayout(`V at τ = ${time()}`, [-0.03, 1.03]), label: `V over the state with ${time()} to go, from ${row(curves.value, state.tau, probability)[0].toFixed(2)} to ${row(curves.value, state.tau, probability)[count - 1].toFixed(2)}`,
    })),
    chart(find(".curve-control"), () => {
      const margin = 0.04 * (control().high - control().low);
      return {
        traces: [curve(actions[state.component], action, control().label, "solid", SERIES[0])],
        layout: { ...curveLayout(`control ${control().label}${unit()} at τ = ${time()}`, [control().low - margin, control().high + margin]), showlegend: false },
        label: `The control over the state with ${time()} to go`,
      };
    }),
    chart(find(".map-value"), () => ({ ...map(columns(curves.value, probability), 0, 1, "Viridis", "V", "V over time to go and state", "#ffffff"), label: "Map of V over the time to go and the state" })),
    chart(find(".map-control"), () => ({ ...map(columns(actions[state.component], action), control().low, control().high, CONTROL, control().label, `control ${control().label}${unit()}`, "#10151c"), label: "Map of the control over the time to go and the state" })),
  ];

  function update() {
    find(".tau").value = state.tau;
    find(".tau").nextElementSibling.textContent = time();
    find(".tau").setAttribute("aria-valuetext", `${short(line.taus[state.tau])} seconds`);
    redraws.forEach((draw) => draw());
  }

  find(".tau").max = line.taus.length - 1;
  find(".component").addEventListener("change", (event) => { state.component = Number(event.target.value); update(); });
  find(".with-paths").addEventListener("change", update);
  find(".tau").addEventListener("input", (event) => { state.tau = Number(event.target.value); update(); });
  update();
}
