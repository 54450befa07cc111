// Meshes and clouds: their buffers, and how they are drawn.

const MESH_VERTEX = `
in vec3 aPosition; in vec3 aNormal; in float aValue; in vec4 aColor;
uniform mat4 uMatrix;
out vec3 vAt, vNormal, vEdge; out vec4 vColor; out float vValue;
void main() {
  vAt = aPosition; vNormal = aNormal; vValue = aValue; vColor = aColor;
  int corner = gl_VertexID % 3;
  vEdge = vec3(corner == 0, corner == 1, corner == 2);
  gl_Position = uMatrix * vec4(aPosition, 1.0);
}`;
const MESH_FRAGMENT = `
in vec3 vAt, vNormal, vEdge; in vec4 vColor; in float vValue;
uniform int uLook;
uniform vec3 uColor;
uniform float uEdges, uOpacity, uLeast, uMost;
out vec4 outColor;
${LIGHT}${MAPPED}
void main() {
  float alpha = uLook == 1 ? vColor.a : 1.0;
  if (alpha < uLeast || alpha > uMost) discard;
  vec3 color = uLook == 0 ? uColor : uLook == 1 ? vColor.rgb : mapped(vValue);
  color = lit(color, vNormal, vAt);
  vec3 width = fwidth(vEdge);
  float inner = min(min(vEdge.x / width.x, vEdge.y / width.y), vEdge.z / width.z);
  // Where triangles are as small as pixels, edges would be all that is seen.
  float fade = 1.0 - smoothstep(0.1, 0.4, max(max(width.x, width.y), width.z));
  color = mix(color, vec3(0.17, 0.24, 0.31), fade * uEdges * (1.0 - smoothstep(0.6, 1.4, inner)));
  alpha *= uOpacity;
  outColor = vec4(color * alpha, alpha);
}`;
const CLOUD_VERTEX = `
in vec3 aPosition; in float aValue; in vec3 aColor;
uniform mat4 uMatrix;
uniform float uPointSize;
out vec3 vColor; out float vValue;
void main() {
  vColor = aColor; vValue = aValue;
  gl_Position = uMatrix * vec4(aPosition, 1.0);
  gl_PointSize = uPointSize;
}`;
const CLOUD_FRAGMENT = `
in vec3 vColor; in float vValue;
uniform int uLook;
uniform vec3 uColor;
uniform float uPointSize;
out vec4 outColor;
${MAPPED}
void main() {
  vec2 at = 2.0 * gl_PointCoord - 1.0;
  float squared = dot(at, at);
  if (uPointSize > 2.5 && squared > 1.0) discard;
  vec3 color = uLook == 0 ? uColor : uLook == 1 ? vColor : mapped(vValue);
  // As a ball that is lit from the viewer.
  outColor = vec4(color * (uPointSize > 2.5 ? 0.55 + 0.45 * sqrt(1.0 - min(squared, 1.0)) : 1.0), 1.0);
}`;

// Edges sharper than this stay sharp, as in geokit.render.figure.
const CREASE = Math.cos((35 * Math.PI) / 180);
// Around vertices of more faces normals are not compared one by one.
const MOST_FACES = 48;

// Normals of the corners (3 F, 4 bytes each): the mean of the faces at the position that are within the crease angle.
function cornerNormals(vertices, faces, positions, positionCount) {
  const count = faces.length / 3, normals = new Float32Array(3 * count), units = new Float32Array(3 * count);
  for (let f = 0; f < count; f++) {
    const a = 3 * faces[3 * f], b = 3 * faces[3 * f + 1], c = 3 * faces[3 * f + 2];
    const ax = vertices[a], ay = vertices[a + 1], az = vertices[a + 2];
    const ux = vertices[b] - ax, uy = vertices[b + 1] - ay, uz = vertices[b + 2] - az;
    const vx = vertices[c] - ax, vy = vertices[c + 1] - ay, vz = vertices[c + 2] - az;
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx, size = Math.hypot(x, y, z);
    normals[3 * f] = x; normals[3 * f + 1] = y; normals[3 * f + 2] = z;
    for (let k = 3 * f; size > 0 && k < 3 * f + 3; k++) units[k] = normals[k] / size;
  }
  const starts = new Int32Array(positionCount + 1), around = new Int32Array(3 * count);
  for (let i = 0; i < positions.length; i++) starts[positions[i] + 1]++;
  for (let i = 0; i < positionCount; i++) starts[i + 1] += starts[i];
  const next = starts.slice();
  for (let i = 0; i < positions.length; i++) around[next[positions[i]]++] = (i / 3) | 0;
  const out = new Int8Array(12 * count);
  for (let i = 0; i < positions.length; i++) {
    const f = 3 * ((i / 3) | 0), from = starts[positions[i]], to = starts[positions[i] + 1];
    const step = Math.max(1, Math.floor((to - from) / MOST_FACES));
    let x = normals[f], y = normals[f + 1], z = normals[f + 2];
    for (let k = from; k < to; k += step) {
      const g = 3 * around[k];
      if (g === f || units[f] * units[g] + units[f + 1] * units[g + 1] + units[f + 2] * units[g + 2] < CREASE) continue;
      x += normals[g]; y += normals[g + 1]; z += normals[g + 2];
    }
    const size = 127 / (Math.hypot(x, y, z) || 1);
    out[4 * i] = Math.round(x * size); out[4 * i + 1] = Math.round(y * size); out[4 * i + 2] = Math.round(z * size);
  }
  return out;
}

// The number of the value at corner i.
function rowOf(at, faces, i) {
  return at === "vertex" ? (faces ? faces[i] : i) : at === "face" ? (i / 3) | 0 : i;
}

async function readSurface(gl, record) {
  const object = { ...record, vertices: await unpack(record.vertices), faces: null };
  if (record.kind === "mesh") {
    object.faces = await unpack(record.faces);
    object.positions = record.positions ? await unpack(record.positions) : object.faces;
  }
  for (const attribute of record.attributes) attribute.values = await unpack(attribute.values);
  const { faces, vertices } = object, count = faces ? faces.length : vertices.length / 3;
  object.count = count;
  object.array = gl.createVertexArray();
  gl.bindVertexArray(object.array);
  if (faces) {
    const corners = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) for (let k = 0; k < 3; k++) corners[3 * i + k] = vertices[3 * faces[i] + k];
    buffer(gl, 0, corners, 3, gl.FLOAT);
    const normals = cornerNormals(vertices, faces, object.positions, record.position_count);
    buffer(gl, 1, normals, 3, gl.BYTE, true, 4);
    object.positions = null;
  } else {
    buffer(gl, 0, vertices, 3, gl.FLOAT);
  }
  if (record.colors) {
    const values = await unpack(record.colors.values), colors = new Uint8Array(4 * count).fill(255);
    const alpha = record.colors.alpha ? await unpack(record.colors.alpha) : null;
    for (let i = 0; i < count; i++) {
      const row = 3 * rowOf(record.colors.at, faces, i);
      for (let k = 0; k < 3; k++) colors[4 * i + k] = values[row + k];
      if (alpha) colors[4 * i + 3] = alpha[i];
    }
    gl.bindVertexArray(object.array);
    buffer(gl, 3, colors, 4, gl.UNSIGNED_BYTE, true, 4);
  }
  gl.bindVertexArray(null);
  object.valueBuffer = gl.createBuffer();
  object.look = { by: record.colors ? "colors" : "plain", color: faces ? "#b9c4cf" : "#c0392b", edges: false,
    opacity: 1, pointSize: clamp(600 / Math.sqrt(count), 1, 8) };
  return object;
}

// Choose what a surface is colored by: "plain", "colors", "x", "y", "z", or the number of an attribute.
function colorBy(gl, object, by, scene) {
  object.look.by = by;
  if (by === "plain" || by === "colors") return;
  const { faces, vertices, count } = object, values = new Float32Array(count), axis = "xyz".indexOf(by);
  const attribute = object.attributes[by];
  for (let i = 0; i < count; i++) {
    const value = attribute
      ? attribute.values[rowOf(attribute.at, faces, i)]
      : vertices[3 * (faces ? faces[i] : i) + axis] * scene.scale + scene.center[axis];
    values[i] = Number.isFinite(value) ? value : MISSING;
  }
  if (attribute) {
    [object.look.from, object.look.to] = [attribute.low, attribute.high];
  } else {
    const found = [scene.low[axis], scene.high[axis]].map((at) => at * scene.scale + scene.center[axis]);
    [object.look.from, object.look.to] = found[0] < found[1] ? found : [found[0] - 0.5, found[0] + 0.5];
  }
  object.look.range = [object.look.from, object.look.to];
  gl.bindVertexArray(object.array);
  gl.bindBuffer(gl.ARRAY_BUFFER, object.valueBuffer);
  gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(2);
  gl.vertexAttribPointer(2, 1, gl.FLOAT, false, 0, 0);
  gl.bindVertexArray(null);
}

const rgb = (text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16) / 255);

// Alpha of what counts as opaque and as nothing, between colors that are interpolated.
const OPAQUE = 0.998, NOTHING = 0.002;

// Whether some of a surface is seen through, so that it is drawn after all that is solid.
const isClear = (object) => object.look.opacity < 1 || Boolean(object.look.by === "colors" && object.colors?.alpha);

function drawSurface(gl, programs, object, shared) {
  const { look } = object, isMapped = look.by !== "plain" && look.by !== "colors";
  const values = {
    ...shared, uLook: isMapped ? 2 : look.by === "colors" ? 1 : 0, uColor: rgb(look.color), uEdges: look.edges ? 1 : 0,
    uOpacity: look.opacity, uPointSize: look.pointSize * shared.ratio, uMap: shared.mapRow(look.map),
    uFrom: look.from, uTo: look.to, uLeast: NOTHING, uMost: 2,
  };
  const program = object.faces ? programs.mesh : programs.cloud;
  gl.bindVertexArray(object.array);
  if (object.faces && isClear(object)) {
    if (look.opacity === 1) {
      use(gl, program, { ...values, uLeast: OPAQUE });
      gl.drawArrays(gl.TRIANGLES, 0, object.count);
      values.uMost = OPAQUE;
    }
    use(gl, program, values);
    // The nearest faces alone: their depths first.
    gl.colorMask(false, false, false, false);
    gl.drawArrays(gl.TRIANGLES, 0, object.count);
    gl.colorMask(true, true, true, true);
    gl.enable(gl.BLEND);
    gl.depthFunc(gl.LEQUAL);
    gl.drawArrays(gl.TRIANGLES, 0, object.count);
    gl.depthFunc(gl.LESS);
    gl.disable(gl.BLEND);
  } else {
    use(gl, program, values);
    gl.drawArrays(object.faces ? gl.TRIANGLES : gl.POINTS, 0, object.count);
  }
  gl.bindVertexArray(null);
}
