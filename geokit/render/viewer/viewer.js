// The page: reads the scene, draws it when something changes, and answers the pointer.

const find = (id) => document.getElementById(id);
const say = (text) => { find("message").textContent = text; find("message").hidden = !text; };

// Of the values at a picked point.
const MOST_LINES = 12;

const state = { objects: [], active: null, moving: false, picked: null };

async function start() {
  setUpTheme();
  const scene = JSON.parse(find("scene").textContent), canvas = find("canvas");
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) {
    say("This page draws with WebGL2, which this browser does not have or has switched off. Update the browser or its "
      + "graphics driver, or switch on hardware acceleration in its settings.");
    return;
  }
  if (typeof DecompressionStream === "undefined") {
    say("This browser cannot decompress the data of this page. Browsers since 2023 can: update it.");
    return;
  }
  canvas.addEventListener("webglcontextlost", () => say("The graphics driver has stopped. Reload the page."));
  const programs = {
    mesh: program(gl, MESH_VERTEX, MESH_FRAGMENT), cloud: program(gl, CLOUD_VERTEX, CLOUD_FRAGMENT),
    iso: program(gl, BOX_VERTEX, ISO_FRAGMENT), fog: program(gl, BOX_VERTEX, FOG_FRAGMENT),
    slice: program(gl, SLICE_VERTEX, SLICE_FRAGMENT),
  };
  const shapes = makeShapes(gl), tables = await unpack(scene.colors);
  const maps = texture(gl, 0, gl.TEXTURE_2D, gl.LINEAR), depth = makeDepth(gl);
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, maps);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 256, scene.maps.length, 0, gl.RGB, gl.UNSIGNED_BYTE, tables);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  gl.enable(gl.DEPTH_TEST);

  for (const record of scene.objects) {
    const read = record.kind === "volume" ? readVolume : readSurface;
    const object = await read(gl, record, scene);
    object.visible = true;
    object.look.map ??= scene.colormap;
    const first = object.attributes?.findIndex((attribute) => !attribute.vector) ?? -1;
    if (!record.colors && first >= 0) colorBy(gl, object, String(first), scene);
    state.objects.push(object);
  }
  const camera = new Camera(scene.low, scene.high, scene.up);
  let asked = false;
  const draw = () => {
    asked = false;
    drawAll(gl, programs, shapes, depth, camera, scene);
    drawLegend(scene, tables);
  };
  const redraw = () => {
    if (!asked) requestAnimationFrame(draw);
    asked = true;
  };
  state.active = state.objects.find(mapShown) ?? null;
  const changed = (object) => {
    if (object) state.active = object;
    redraw();
  };
  buildPanel(find("panel"), state.objects, scene, gl, changed);
  let fitted = false;
  const resize = () => {
    const { clientWidth: width, clientHeight: height } = canvas, ratio = window.devicePixelRatio || 1;
    if (!width || !height) return;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    camera.aspect = width / height;
    if (!fitted) camera.fit();
    draw();
  };
  new ResizeObserver(resize).observe(canvas);
  const settle = steer(canvas, camera, redraw, (x, y) => {
    state.picked = pickAt(canvas, camera, x, y);
    showPicked(scene);
    redraw();
    return state.picked;
  }, () => { fitted = true; });

  find("up").value = scene.up;
  find("up").onchange = () => { camera.up = find("up").value; camera.fit(); redraw(); };
  find("fit").onclick = () => { camera.fit(); redraw(); };
  find("shot").onclick = () => { draw(); saveShot(canvas, scene, tables); };
  find("theme").addEventListener("click", redraw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  const panelButton = find("panel-button"), togglePanel = (on) => {
    find("panel").hidden = !on;
    panelButton.setAttribute("aria-expanded", String(on));
  };
  panelButton.onclick = () => togglePanel(find("panel").hidden);
  togglePanel(window.innerWidth > 700);
  document.addEventListener("keydown", (event) => {
    if (event.target.matches?.("input, select") || event.ctrlKey || event.metaKey || event.altKey) return;
    const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
    if (event.key === "o") togglePanel(find("panel").hidden);
    else if (event.key === "f") camera.fit();
    else if (event.key === "+" || event.key === "-") camera.zoom(event.key === "+" ? 0.9 : 1 / 0.9);
    else if (turns[event.key] && event.target === canvas) { camera.turn(...turns[event.key]); event.preventDefault(); }
    else return;
    fitted = true;
    redraw();
    settle();
  });
  say("");
  resize();
  document.documentElement.dataset.ready = "yes";
}

function setUpTheme() {
  const root = document.documentElement, dark = matchMedia("(prefers-color-scheme: dark)");
  let chosen = null;
  const set = () => {
    root.dataset.theme = chosen ?? (dark.matches ? "dark" : "light");
    find("theme").textContent = root.dataset.theme === "dark" ? "Light" : "Dark";
  };
  set();
  dark.addEventListener("change", set);
  find("theme").addEventListener("click", () => { chosen = root.dataset.theme === "dark" ? "light" : "dark"; set(); });
}

function makeShapes(gl) {
  const shape = (points) => {
    const made = gl.createVertexArray();
    gl.bindVertexArray(made);
    buffer(gl, 0, new Float32Array(points), 3, gl.FLOAT);
    gl.bindVertexArray(null);
    return made;
  };
  const box = [];
  // Two triangles a side, counterclockwise from outside.
  const corners = [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]];
  for (let axis = 0; axis < 3; axis++)
    for (const side of [0, 1])
      for (const [u, v] of side ? corners : [...corners].reverse()) {
        const point = [0, 0, 0];
        point[axis] = side;
        point[(axis + 1) % 3] = u;
        point[(axis + 2) % 3] = v;
        box.push(...point);
      }
  return { box: shape(box), square: shape([0, 0, 0, 1, 0, 0, 0, 1, 0, 1, 1, 0]), point: shape([0, 0, 0]) };
}

// Depths of what stands in fog; as large as the canvas, made when first needed.
function makeDepth(gl) {
  return { frame: gl.createFramebuffer(), made: texture(gl, 1, gl.TEXTURE_2D, gl.NEAREST), width: 0, height: 0 };
}

function bindDepth(gl, depth, width, height) {
  gl.activeTexture(gl.TEXTURE1);
  gl.bindFramebuffer(gl.FRAMEBUFFER, depth.frame);
  if (depth.width === width && depth.height === height) return;
  Object.assign(depth, { width, height });
  gl.bindTexture(gl.TEXTURE_2D, depth.made);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.DEPTH_COMPONENT24, width, height, 0, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depth.made, 0);
}

function drawAll(gl, programs, shapes, depth, camera, scene) {
  const { width, height } = gl.canvas, matrix = camera.matrix, { side, upwards, towards } = camera.frame;
  const shared = {
    uMatrix: matrix, uEye: camera.eye, uMaps: 0, moving: state.moving, ratio: window.devicePixelRatio || 1,
    uKey: unit(plus(plus(towards, upwards, 0.6), side, -0.45)),
    uFill: unit(plus(plus(towards, upwards, -0.5), side, 0.8)),
    mapRow: (name) => (scene.maps.indexOf(name) + 0.5) / scene.maps.length,
  };
  const visible = state.objects.filter((object) => object.visible);
  const isSolid = (object) => object.kind === "volume" || !isClear(object);
  const drawSolid = () => {
    for (const object of visible.filter(isSolid)) {
      if (object.kind === "volume") drawVolume(gl, programs, shapes, object, shared);
      else drawSurface(gl, programs, object, shared);
    }
  };
  gl.viewport(0, 0, width, height);
  const fog = visible.filter((object) => object.kind === "volume" && object.look.draw === "fog");
  if (fog.length) {
    bindDepth(gl, depth, width, height);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    drawSolid();
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }
  const back = rgb(getComputedStyle(document.documentElement).getPropertyValue("--back").trim());
  gl.clearColor(...back, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  drawSolid();
  const fromClip = inverse(matrix);
  for (const object of fog) drawFog(gl, programs, shapes, object, shared, fromClip);
  for (const object of visible.filter((each) => !isSolid(each))) drawSurface(gl, programs, object, shared);
  if (state.picked) drawMark(gl, programs, shapes, shared, state.picked.at);
}

// A ring of two colors, seen on everything.
function drawMark(gl, programs, shapes, shared, at) {
  gl.disable(gl.DEPTH_TEST);
  const moved = product(shared.uMatrix, [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, ...at, 1]);
  gl.bindVertexArray(shapes.point);
  for (const [color, size] of [[[0, 0, 0], 11], [[1, 0.85, 0.1], 7]]) {
    use(gl, programs.cloud, { ...shared, uMatrix: moved, uLook: 0, uColor: color, uPointSize: size * shared.ratio });
    gl.drawArrays(gl.POINTS, 0, 1);
  }
  gl.bindVertexArray(null);
  gl.enable(gl.DEPTH_TEST);
}

// The object whose color map the legend shows: the one that was last changed, else the first.
function legendOf() {
  const isShown = (object) => object && object.visible && mapShown(object);
  return isShown(state.active) ? state.active : state.objects.find(isShown) ?? null;
}

const legendName = (object) =>
  object.kind === "volume" ? object.name
    : AXES.includes(object.look.by) ? object.look.by : labelOf(object.attributes[object.look.by]);

// Texts of the two ends, which say where values lie beyond.
function endsOf(object) {
  const { from, to, range } = object.look, text = (value) => String(Number(value.toPrecision(4)));
  return [(range[0] < from ? "\u2264 " : "") + text(from), (range[1] > to ? "\u2265 " : "") + text(to)];
}

function drawLegend(scene, tables) {
  const object = legendOf(), legend = find("legend");
  legend.hidden = !object;
  if (!object) return;
  legend.children[0].textContent = legendName(object);
  drawBar(legend.children[1].getContext("2d"), scene, tables, object, 0, 0, 256, 1);
  const [from, to] = legend.children[2].children;
  [from.textContent, to.textContent] = endsOf(object);
}

function drawBar(context, scene, tables, object, x, y, width, height) {
  const first = 768 * scene.maps.indexOf(object.look.map);
  for (let i = 0; i < 256; i++) {
    const at = first + 3 * i;
    context.fillStyle = `rgb(${tables[at]} ${tables[at + 1]} ${tables[at + 2]})`;
    context.fillRect(x + (i * width) / 256, y, width / 256 + 0.5, height);
  }
}

// The picture with its legend, as a file.
function saveShot(canvas, scene, tables) {
  const copy = element("canvas", { width: canvas.width, height: canvas.height }), context = copy.getContext("2d");
  context.drawImage(canvas, 0, 0);
  const object = legendOf(), ratio = window.devicePixelRatio || 1;
  if (object) {
    const [from, to] = endsOf(object);
    const width = 220 * ratio, x = copy.width - width - 16 * ratio, y = copy.height - 36 * ratio;
    drawBar(context, scene, tables, object, x, y, width, 12 * ratio);
    context.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--front");
    context.font = `${13 * ratio}px system-ui, sans-serif`;
    context.fillText(legendName(object), x, y - 6 * ratio);
    context.fillText(from, x, y + 26 * ratio);
    context.textAlign = "right";
    context.fillText(to, x + width, y + 26 * ratio);
  }
  copy.toBlob((blob) => {
    const link = element("a", { href: URL.createObjectURL(blob), download: "geokit.png" });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  });
}

function pickAt(canvas, camera, clientX, clientY) {
  const box = canvas.getBoundingClientRect();
  const x = (2 * (clientX - box.left)) / box.width - 1, y = 1 - (2 * (clientY - box.top)) / box.height;
  const found = pick(state.objects, camera.ray(x, y), (2 * camera.tangent) / box.height);
  if (found?.exact) found.at = found.exact;
  return found;
}

function showPicked(scene) {
  const box = find("picked"), found = state.picked;
  box.hidden = !found;
  if (!found) return;
  const world = found.at.map((at, k) => shown(at * scene.scale + scene.center[k]));
  const lines = [["position", world.join(", ")], ...found.lines.map(([name, value]) =>
    [name, typeof value === "number" ? shown(value) : value])];
  const rows = lines.slice(0, MOST_LINES).map(([name, value]) =>
    element("tr", {}, element("th", {}, name), element("td", { "data-name": name }, String(value))));
  box.replaceChildren(element("b", {}, found.object.name), element("table", {}, ...rows));
}

// Mouse, touch and wheel. Returns a function that draws once more in full quality when nothing moves any longer.
function steer(canvas, camera, redraw, picks, moved) {
  const pointers = new Map();
  let traveled = 0, timer = 0, lastTap = -Infinity;
  const settle = () => {
    clearTimeout(timer);
    timer = setTimeout(() => { state.moving = false; redraw(); }, 150);
  };
  const move = () => {
    state.moving = true;
    moved();
    redraw();
    settle();
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    if (!pointers.size) traveled = 0;
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (pointers.size > 1) traveled = Infinity;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], height = canvas.clientHeight;
    const right = now[0] - before[0], down = now[1] - before[1];
    traveled += Math.abs(right) + Math.abs(down);
    // A trembling hand still clicks.
    if (traveled < 5) return;
    if (pointers.size > 1) {
      const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      const gap = (at) => Math.max(Math.hypot(at[0] - other[0], at[1] - other[1]), 1);
      camera.zoom(gap(before) / gap(now));
      // Each finger moves the middle by half.
      camera.pan((0.5 * right) / height, (-0.5 * down) / height);
    } else if (event.shiftKey || event.buttons & 6) {
      camera.pan(right / height, -down / height);
    } else {
      camera.turn((4 * right) / height, (4 * down) / height);
    }
    pointers.set(event.pointerId, now);
    move();
  });
  const end = (event) => {
    if (!pointers.delete(event.pointerId) || pointers.size || event.type !== "pointerup" || traveled >= 5) return;
    if (event.button !== 0) return;
    const found = picks(event.clientX, event.clientY), isSecond = event.timeStamp - lastTap < 350;
    lastTap = event.timeStamp;
    if (isSecond && found) {
      camera.target = found.at;
      move();
    }
  };
  canvas.addEventListener("pointerup", end);
  canvas.addEventListener("pointercancel", end);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.zoom(Math.exp(clamp(event.deltaY * (event.deltaMode ? 30 : 1), -300, 300) * 0.0012));
    move();
  }, { passive: false });
  return settle;
}

start().catch((error) => say(`The page cannot be drawn: ${error.message}`));
