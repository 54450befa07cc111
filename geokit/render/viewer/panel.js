// The list of objects with their settings.

function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.includes("-")) made.setAttribute(name, value); else made[name] = value;
  }
  made.append(...children);
  return made;
}

const row = (text, ...inputs) => element("label", { className: "row" }, element("span", {}, text), ...inputs);

function choice(options, chosen, change) {
  const made = element("select", { onchange: () => change(made.value) });
  for (const [value, text] of options) made.append(element("option", { value, selected: value === chosen }, text));
  return made;
}

// A slider with its number; `from` and `to` of the slider's share make logarithmic ones.
function slider(name, { low, high, value, number = (share) => share, share = (at) => at }, change) {
  const text = (found) => Number.isFinite(found) ? String(Number(found.toPrecision(4))) : shown(found);
  const output = element("output", {}, text(value));
  const input = element("input", { type: "range", min: low, max: high, step: (high - low) / 1000, "data-name": name });
  input.value = share(value);
  input.oninput = () => {
    const found = number(Number(input.value));
    output.textContent = text(found);
    change(found);
  };
  return element("span", { className: "slider" }, input, output);
}

function checkbox(checked, change, more = {}) {
  const made = element("input", { type: "checkbox", checked, ...more });
  made.onchange = () => change(made.checked);
  return made;
}

const color = (value, change) => {
  const made = element("input", { type: "color", value });
  made.oninput = () => change(made.value);
  return made;
};

function buildPanel(panel, objects, scene, gl, changed) {
  panel.replaceChildren();
  objects.forEach((object, number) => {
    const rows = element("div");
    const box = checkbox(object.visible, (on) => { object.visible = on; changed(object); },
      { "aria-label": `Show ${object.name}`, "data-name": `show-${number}` });
    // A click on the box is not one on the summary.
    box.onclick = (event) => event.stopPropagation();
    const name = element("b", { title: object.name }, object.name);
    const open = objects.length <= 2 || number === 0;
    panel.append(element("section", {}, element("details", { open }, element("summary", {}, box, name), rows)));
    const fill = () => {
      rows.replaceChildren(element("p", { className: "facts" }, factsOf(object)));
      if (object.coarser > 1)
        rows.append(element("p", { className: "note" },
          `Shown ${object.coarser.toFixed(2)} times coarser than its voxels: more of them do not fit in the page.`));
      const settings = object.kind === "volume" ? volumeRows : surfaceRows;
      rows.append(...settings(object, scene, gl, () => changed(object), fill));
    };
    fill();
  });
  panel.append(element("p", { className: "help" },
    "Drag to turn; with shift, the right button or two fingers to move; wheel or pinch to zoom. Click to read values; "
    + "double-click to turn around that point."));
}

function factsOf(object) {
  const many = (number) => number.toLocaleString("en-US");
  if (object.kind === "mesh")
    return `mesh: ${many(object.vertices.length / 3)} vertices, ${many(object.faces.length / 3)} triangles`;
  if (object.kind === "cloud") return `cloud: ${many(object.vertices.length / 3)} points`;
  const active = object.active === null ? "" : `, ${many(object.active)} active voxels`;
  const grid = object.grid && object.grid !== object.name ? ` ${object.grid}` : "";
  return `${object.isLevelSet ? "level set" : "volume"}${grid}: ${object.size.join(" x ")}${active}`;
}

function mapRows(object, scene, changed) {
  const { look } = object;
  const number = (name) => {
    const made = element("input", { type: "number", step: "any", value: shown(look[name]), "aria-label": name });
    made.onchange = () => {
      const value = Number(made.value), other = name === "from" ? look.to - value : value - look.from;
      if (made.value !== "" && other > 0) { look[name] = value; changed(); } else { made.value = shown(look[name]); }
    };
    return made;
  };
  return [
    row("Color map", choice(scene.maps.map((name) => [name, name]), look.map,
      (value) => { look.map = value; changed(); })),
    element("div", { className: "row" }, element("span", {}, "Range"),
      element("span", { className: "both" }, number("from"), number("to"))),
  ];
}

function surfaceRows(object, scene, gl, changed, fill) {
  const { look } = object;
  const own = object.colors ? [["colors", "own colors"]] : [];
  const options = [...own, ["plain", "one color"], ...AXES.map((a) => [a, a]),
    ...object.attributes.map((attribute, i) =>
      [String(i), `${labelOf(attribute)} (${object.faces ? attribute.at : "point"})`])];
  const rows = [row("Color by", choice(options, look.by, (value) => {
    colorBy(gl, object, value, scene);
    fill();
    changed();
  }))];
  if (look.by === "plain") rows.push(row("Color", color(look.color, (value) => { look.color = value; changed(); })));
  else if (look.by !== "colors") rows.push(...mapRows(object, scene, changed));
  if (object.faces) {
    rows.push(row("Edges", checkbox(look.edges, (on) => { look.edges = on; changed(); }, { "data-name": "edges" })));
    rows.push(row("Opacity", slider("opacity", { low: 0.05, high: 1, value: look.opacity },
      (value) => { look.opacity = value; changed(); })));
  } else {
    rows.push(row("Point size", slider("size", { low: 1, high: 16, value: look.pointSize },
      (value) => { look.pointSize = value; changed(); })));
  }
  return rows;
}

function volumeRows(object, scene, gl, changed, fill) {
  const { look } = object, rows = [];
  const ways = [["surface", "surface"], ["fog", "fog"], ["none", "slices only"]];
  rows.push(row("Draw as", choice(ways, look.draw, (value) => { look.draw = value; fill(); changed(); })));
  if (look.draw === "surface") {
    const range = { low: object.low, high: object.high, value: look.isovalue };
    rows.push(row("Isovalue", slider("isovalue", range, (value) => { look.isovalue = value; changed(); })));
    rows.push(row("Color", color(look.color, (value) => { look.color = value; changed(); })));
  }
  if (look.draw === "fog") {
    const range = { low: -2, high: 2, value: look.density, number: (at) => 10 ** at, share: Math.log10 };
    rows.push(row("Density", slider("density", range, (value) => { look.density = value; changed(); })));
  }
  AXES.forEach((axis, k) => {
    const input = element("input", { type: "range", min: 0, max: 1, step: 0.001, "data-name": `slice-${axis}`,
      "aria-label": `Position of slice ${axis}` });
    input.value = look.slices[k] ?? 0.5;
    const box = checkbox(look.slices[k] !== null, (on) => {
      const before = mapShown(object);
      look.slices[k] = on ? Number(input.value) : null;
      if (mapShown(object) !== before) fill();
      changed();
    }, { "data-name": `slice-${axis}-on` });
    input.oninput = () => { look.slices[k] = Number(input.value); box.checked = true; changed(); };
    rows.push(element("label", { className: "row" }, element("span", {}, `Slice ${axis}`),
      element("span", { className: "slider check" }, box, input)));
  });
  if (mapShown(object)) rows.push(...mapRows(object, scene, changed));
  return rows;
}

// Whether a color map is in use.
function mapShown(object) {
  const { look } = object;
  if (object.kind === "volume") return look.draw === "fog" || look.slices.some((share) => share !== null);
  return look.by !== "plain" && look.by !== "colors";
}
