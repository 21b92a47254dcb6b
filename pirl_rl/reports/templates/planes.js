// Problems with several states: maps of V and of the control on planes, with sliders for further coordinates.

// The slice of a layer at a time to go and a value of a further coordinate, as rows of a map.
function slice(codes, plane, t, levels, level, turn) {
  const side = plane.side, start = (t * levels + level) * side * side;
  return Array.from({ length: side }, (_, i) => Array.from(codes.subarray(start + i * side, start + (i + 1) * side), turn));
}

async function explorePlanes(root) {
  const data = dataOf(root), find = (name) => root.querySelector(name);
  const state = { plane: 0, component: 0, tau: 0, active: 0, levels: [] };
  const layers = new Map();

  async function layer() {
    const key = `${state.plane}-${state.active}`;
    if (!layers.has(key)) {
      const packed = data.planes[state.plane].layers[state.active];
      const sets = {};
      for (const [name, text] of Object.entries(packed.sets)) sets[name] = await unpacked(text, 1);
      layers.set(key, { sets, value: await unpacked(packed.value, 1), control: await Promise.all(packed.control.map((text) => unpacked(text, 1))) });
    }
    return layers.get(key);
  }

  const shown = {};
  async function read() {
    const plane = data.planes[state.plane], packed = await layer(), further = plane.further[state.active];
    const count = further ? further.values.length : 1, level = further ? state.levels[state.active] : 0;
    const along = (axisIndex) => Array.from({ length: plane.side }, (_, i) => plane.low[axisIndex] + (plane.high[axisIndex] - plane.low[axisIndex]) * i / (plane.side - 1));
    const control = data.controls[state.component];
    const rows = (codes, t, turn) => slice(codes, plane, t, count, level, turn);
    const sets = {};
    for (const name of ["target", "avoid"]) sets[name] = packed.sets[name] ? rows(packed.sets[name], 0, (code) => 127.5 - code) : null;
    const inside = (i, j) => Object.values(sets).some((set) => set && set[i][j] > 0);
    Object.assign(shown, {
      plane, control, sets, inside, value: rows(packed.value, state.tau, (code) => code / 255), x: along(0), y: along(1), tau: plane.taus[state.tau],
      action: rows(packed.control[state.component], state.tau, (code) => control.low + (control.high - control.low) * code / 255)
        .map((row, i) => row.map((entry, j) => (inside(i, j) ? null : entry))),
    });
  }

  function traces(first, colour) {
    const { plane, x, y, value, sets, tau } = shown;
    const found = [first, lines(x, y, value, colour)];
    const crossed = (rows) => rows && rows.some((row) => row.some((entry) => entry > 0)) && rows.some((row) => row.some((entry) => entry < 0));
    if (crossed(sets.avoid)) found.push(outline(x, y, sets.avoid, AVOID));
    if (crossed(sets.target)) found.push(outline(x, y, sets.target, TARGET));
    const seams = plane.periodic.map((is, j) => (is ? plane.high[j] - plane.low[j] : 0));
    if (find(".with-paths").checked) found.push(...pathTraces(data.paths, data.paths.points[state.plane], tau, (point) => point, seams));
    return found;
  }

  function layout(text) {
    const { plane } = shown;
    return {
      title: title(text), showlegend: false, margin: { l: 52, r: 8, t: 34, b: 46 },
      xaxis: axis({ title: plane.labels[0], range: [plane.low[0], plane.high[0]], constrain: "domain" }), yaxis: axis({
        title: plane.labels[1], range: [plane.low[1], plane.high[1]], ...(plane.equal ? { scaleanchor: "x", constrain: "domain" } : {}),
      }),
    };
  }

  // A plane with equal scales fills a chart of its own shape.
  function shape(element) {
    const { plane } = shown, ratio = (plane.high[1] - plane.low[1]) / (plane.high[0] - plane.low[0]);
    const height = (element.clientWidth - 110) * ratio + 90;
    element.style.height = plane.equal ? `${Math.round(Math.min(Math.max(height, 220), 480))}px` : "";
  }

  function mean() {
    const outside = shown.value.flatMap((row, i) => row.filter((_, j) => !shown.inside(i, j)));
    return outside.length ? `mean of V outside both sets ${(outside.reduce((a, b) => a + b, 0) / outside.length).toFixed(2)}` : "all of it in a set";
  }

  const draws = [
    () => chart(find(".map-value"), () => ({
      traces: traces(heat(shown.x, shown.y, shown.value, 0, 1, "Viridis", "V"), "#ffffff"),
      layout: layout(`V on the plane ${shown.plane.name}, τ = ${short(shown.tau)} s`), label: `Map of V on the plane ${shown.plane.name} with ${short(shown.tau)} s to go: ${mean()}`,
    })),
    () => chart(find(".map-control"), () => ({
      traces: traces(heat(shown.x, shown.y, shown.action, shown.control.low, shown.control.high, CONTROL, shown.control.label), "#10151c"),
      layout: layout(`control ${shown.control.label}${shown.control.unit ? ` (${shown.control.unit})` : ""}`), label: `Map of the control on the plane ${shown.plane.name} with ${short(shown.tau)} s to go`,
    })),
  ];

  function words() {
    const { plane } = shown, moved = plane.further[state.active];
    const stands = plane.fixed.filter(([name]) => !moved || name !== moved.label).map(([name, value]) => `${name} = ${value}`);
    const one = moved ? `${moved.label} is that of its slider. ` : "";
    const rest = stands.length ? `On this plane ${stands.join(", ")}. ` : "";
    const rule = plane.further.length > 1 ? "One of these coordinates moves at a time, and the others return to the plane. " : "";
    const more = plane.left_out ? `${plane.left_out} coordinates in which V varies less have no slider. ` : "";
    find(".where").innerHTML = one + rest + rule + more + (data.paths.points.length && plane.fixed.length ? "Along a path they change, and the map does not follow." : "");
  }

  function sliders() {
    const place = find(".further"), plane = data.planes[state.plane];
    place.replaceChildren();
    state.levels = plane.further.map((entry) => entry.start);
    plane.further.forEach((entry, i) => {
      const id = `further-${root.dataset.run}-${i}`, box = document.createElement("div");
      box.className = "slider";
      box.innerHTML = `<label for="${id}">${entry.label}</label><input id="${id}" type="range" min="0" max="${entry.values.length - 1}" step="1" value="${entry.start}"><output for="${id}"></output>`;
      box.querySelector("input").addEventListener("input", (event) => {
        state.levels = plane.further.map((other, j) => (j === i ? Number(event.target.value) : other.start));
        state.active = i;
        update();
      });
      place.append(box);
    });
  }

  let redraws = null;
  async function update() {
    const plane = data.planes[state.plane];
    await read();
    find(".tau").value = state.tau;
    find(".tau").nextElementSibling.textContent = `${short(shown.tau)} s`;
    find(".tau").setAttribute("aria-valuetext", `${short(shown.tau)} seconds`);
    root.querySelectorAll(".further .slider").forEach((box, i) => {
      const input = box.querySelector("input"), value = short(plane.further[i].values[state.levels[i]]);
      input.value = state.levels[i];
      input.setAttribute("aria-valuetext", value);
      box.querySelector("output").textContent = value;
    });
    words();
    [".map-value", ".map-control"].forEach((name) => shape(find(name)));
    if (redraws) redraws.forEach((draw) => draw());
    else redraws = draws.map((draw) => draw());
  }

  async function change() {
    state.plane = Number(find(".plane").value);
    state.active = 0;
    state.tau = data.planes[state.plane].start;
    find(".tau").max = data.planes[state.plane].taus.length - 1;
    sliders();
    await update();
  }

  find(".plane").addEventListener("change", change);
  find(".component").addEventListener("change", (event) => { state.component = Number(event.target.value); update(); });
  find(".with-paths").addEventListener("change", update);
  find(".tau").addEventListener("input", (event) => { state.tau = Number(event.target.value); update(); });
  await change();
}
