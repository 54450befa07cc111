// WebGL programs and what they share: light, color maps, and how a field is read from a 3D texture.

const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler3D;
`;

// Light comes from the upper left of the viewer, and less of it from the lower right.
const LIGHT = `
uniform vec3 uKey, uFill, uEye;
vec3 lit(vec3 color, vec3 normal, vec3 at) {
  vec3 view = normalize(uEye - at);
  vec3 n = normalize(normal);
  n = dot(n, view) < 0.0 ? -n : n;
  float shine = pow(max(dot(n, normalize(uKey + view)), 0.0), 24.0);
  return color * (0.22 + 0.68 * max(dot(n, uKey), 0.0) + 0.2 * max(dot(n, uFill), 0.0)) + 0.1 * shine;
}
`;

// NaN and infinities arrive as MISSING.
const MISSING = -3e38;
const MAPPED = `
uniform sampler2D uMaps;
uniform float uMap, uFrom, uTo;
vec3 mapped(float value) {
  if (value <= -2.9e38) return vec3(0.7);
  float share = clamp((value - uFrom) / (uTo - uFrom), 0.0, 1.0);
  return texture(uMaps, vec2((share * 255.0 + 0.5) / 256.0, uMap)).rgb;
}
`;

// Positions of a field are indices: 0 is the first sample's center.
const FIELD = `
uniform sampler3D uField;
uniform vec3 uSize;
uniform float uScale;
float quick(vec3 at) { return uScale * texture(uField, (at + 0.5) / uSize).r; }
// Weights of the hardware have 8 bits, which shows in normals.
float exact(vec3 at) {
  vec3 inside = clamp(at, vec3(0.0), uSize - 1.0), low = floor(inside), w = inside - low;
  ivec3 a = ivec3(low), b = min(a + 1, ivec3(uSize) - 1);
  #define AT(i, j, k) texelFetch(uField, ivec3(i.x, j.y, k.z), 0).r
  float c00 = mix(AT(a, a, a), AT(b, a, a), w.x), c10 = mix(AT(a, b, a), AT(b, b, a), w.x);
  float c01 = mix(AT(a, a, b), AT(b, a, b), w.x), c11 = mix(AT(a, b, b), AT(b, b, b), w.x);
  return uScale * mix(mix(c00, c10, w.y), mix(c01, c11, w.y), w.z);
}
`;

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, HEAD + text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost())
      throw new Error(gl.getShaderInfoLog(shader));
  }
  ["aPosition", "aNormal", "aValue", "aColor"].forEach((name, at) => gl.bindAttribLocation(made, at, name));
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(made));
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const { name, type } = gl.getActiveUniform(made, i);
    uniforms[name] = { type, at: gl.getUniformLocation(made, name) };
  }
  return { made, uniforms };
}

// Use a program with values for its uniforms; textures are given as their unit. Names that it lacks are skipped.
function use(gl, { made, uniforms }, values) {
  gl.useProgram(made);
  for (const [name, value] of Object.entries(values)) {
    const found = uniforms[name];
    if (!found) continue;
    switch (found.type) {
      case gl.FLOAT: gl.uniform1f(found.at, value); break;
      case gl.FLOAT_VEC2: gl.uniform2fv(found.at, value); break;
      case gl.FLOAT_VEC3: gl.uniform3fv(found.at, value); break;
      case gl.FLOAT_MAT3: gl.uniformMatrix3fv(found.at, false, value); break;
      case gl.FLOAT_MAT4: gl.uniformMatrix4fv(found.at, false, value); break;
      default: gl.uniform1i(found.at, value);
    }
  }
}

function buffer(gl, at, values, size, kind, normalized = false, stride = 0) {
  const made = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, made);
  gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(at);
  gl.vertexAttribPointer(at, size, kind, normalized, stride, 0);
  return made;
}

function texture(gl, unit, target, filter) {
  const made = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(target, made);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, name, filter);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R])
    gl.texParameteri(target, name, gl.CLAMP_TO_EDGE);
  return made;
}
