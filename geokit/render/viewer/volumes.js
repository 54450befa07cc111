// Volumes: rays marched through a 3D texture, as a surface or as fog, and slices of it.

const BOX_VERTEX = `
in vec3 aPosition;
uniform mat4 uMatrix, uModel;
uniform vec3 uSize;
out vec3 vAt;
void main() {
  vAt = aPosition * (uSize - 1.0);
  gl_Position = uMatrix * (uModel * vec4(vAt, 1.0));
}`;
// A ray in indices, where it is in the box, and where it leaves a block that nothing is drawn in.
const RAY = `
in vec3 vAt;
uniform vec3 uEyeIndex;
uniform sampler3D uBlocks;
uniform float uStep;
out vec4 outColor;
${FIELD}
const float BLOCK = 8.0;
struct Ray { vec3 from, along, inverse; float near, far; };
Ray rayHere() {
  vec3 d = normalize(vAt - uEyeIndex);
  d = mix(d, vec3(1e-7), lessThan(abs(d), vec3(1e-7)));
  vec3 a = -uEyeIndex / d, b = (uSize - 1.0 - uEyeIndex) / d, low = min(a, b), high = max(a, b);
  return Ray(uEyeIndex, d, 1.0 / d, max(max(max(low.x, low.y), low.z), 0.0), min(min(high.x, high.y), high.z));
}
vec2 rangeAt(vec3 at, out vec3 cell) {
  cell = clamp(floor(at / BLOCK), vec3(0.0), vec3(textureSize(uBlocks, 0)) - 1.0);
  return texelFetch(uBlocks, ivec3(cell), 0).rg;
}
float leaves(Ray ray, vec3 cell) {
  vec3 t = (BLOCK * (cell + step(vec3(0.0), ray.along)) - ray.from) * ray.inverse;
  return min(min(t.x, t.y), t.z);
}`;
const ISO_FRAGMENT = `
${RAY}
uniform mat4 uMatrix, uModel;
uniform mat3 uToNormal;
uniform float uIsovalue;
uniform vec3 uColor;
${LIGHT}
float above(Ray ray, float t) { return exact(ray.from + t * ray.along) - uIsovalue; }
// Draw the crossing between a and b, where the field has different signs.
void draw(Ray ray, float a, float b) {
  bool first = above(ray, a) < 0.0;
  for (int k = 0; k < 12; k++) {
    float middle = 0.5 * (a + b);
    if ((above(ray, middle) < 0.0) == first) a = middle; else b = middle;
  }
  vec3 hit = ray.from + 0.5 * (a + b) * ray.along;
  vec2 h = vec2(0.7, 0.0);
  vec3 slope = vec3(exact(hit + h.xyy) - exact(hit - h.xyy), exact(hit + h.yxy) - exact(hit - h.yxy),
                    exact(hit + h.yyx) - exact(hit - h.yyx));
  vec4 local = uModel * vec4(hit, 1.0), clip = uMatrix * local;
  gl_FragDepth = 0.5 * clip.z / clip.w + 0.5;
  outColor = vec4(lit(uColor, uToNormal * slope, local.xyz), 1.0);
}
void main() {
  Ray ray = rayHere();
  // The last two samples in a row, at t - step and at t - 2 step.
  float t = ray.near, before = 0.0, older = 0.0, t_before = 0.0, t_older = 0.0;
  int known = 0;
  for (int i = 0; i < 8192 && t <= ray.far; i++) {
    vec3 cell, at = ray.from + t * ray.along;
    vec2 range = rangeAt(at, cell);
    if (uIsovalue < range.x || uIsovalue > range.y) {
      t = max(leaves(ray, cell), t) + 2e-3;
      known = 0;
      continue;
    }
    float now = quick(at) - uIsovalue;
    if (known > 0 && (now < 0.0) != (before < 0.0)) { draw(ray, t_before, t); return; }
    // Between samples a field with a crease is lower by half of what they differ, at most.
    bool closest = known > 0 && abs(before) <= abs(now) && (known < 2 || abs(before) <= abs(older)
      && abs(before) <= 0.6 * (abs(older - before) + abs(now - before)));
    if (closest) {
      // A ray that grazes the surface is inside for less than a step: look where it comes closest.
      float start = known < 2 ? t_before : t_older, a = start, b = t;
      for (int k = 0; k < 5; k++) {
        float c = mix(a, b, 0.382), d = mix(a, b, 0.618), at_c = above(ray, c), at_d = above(ray, d);
        bool c_in = (at_c < 0.0) != (before < 0.0), d_in = (at_d < 0.0) != (before < 0.0);
        if (c_in || d_in) { draw(ray, start, c_in ? c : d); return; }
        if (abs(at_c) < abs(at_d)) b = d; else a = c;
      }
    }
    older = before;
    t_older = t_before;
    before = now;
    t_before = t;
    known = min(known + 1, 2);
    // The last step ends at the face of the box.
    t = t < ray.far ? min(t + uStep, ray.far) : t + uStep;
  }
  discard;
}`;
const FOG_FRAGMENT = `
${RAY}
uniform sampler2D uDepth;
uniform mat4 uFromClip;
uniform mat3 uToLocal;
uniform float uDensity;
${MAPPED}
float noise(vec2 at) { return fract(52.9829189 * fract(dot(at, vec2(0.06711056, 0.00583715)))); }
void main() {
  Ray ray = rayHere();
  // Up to what stands in the fog.
  vec2 screen = gl_FragCoord.xy / vec2(textureSize(uDepth, 0));
  vec4 stop = uFromClip * vec4(2.0 * vec3(screen, texture(uDepth, screen).r) - 1.0, 1.0);
  float far = min(ray.far, dot(stop.xyz / stop.w - ray.from, ray.along));
  float thickness = uDensity * uStep * length(uToLocal * ray.along) / (uTo - uFrom);
  vec4 sum = vec4(0.0);
  float t = ray.near + uStep * noise(gl_FragCoord.xy);
  for (int i = 0; i < 8192 && t < far && sum.a < 0.995; i++) {
    vec3 cell, at = ray.from + t * ray.along;
    vec2 range = rangeAt(at, cell);
    if (range.y <= uFrom) {
      // Whole steps, so that the pattern of the noise stays.
      t += uStep * max(ceil((leaves(ray, cell) - t) / uStep), 1.0);
      continue;
    }
    float value = quick(at);
    float alpha = 1.0 - exp(-thickness * max(value - uFrom, 0.0));
    sum += (1.0 - sum.a) * alpha * vec4(mapped(value), 1.0);
    t += uStep;
  }
  outColor = sum;
}`;
const SLICE_VERTEX = `
in vec3 aPosition;
uniform mat4 uMatrix, uModel;
uniform vec3 uSize;
uniform float uAt;
uniform int uAxis;
out vec3 vAt;
void main() {
  vec2 at = aPosition.xy;
  vAt = uAxis == 0 ? vec3(uAt, at) : uAxis == 1 ? vec3(at.x, uAt, at.y) : vec3(at, uAt);
  vAt *= uSize - 1.0;
  gl_Position = uMatrix * (uModel * vec4(vAt, 1.0));
}`;
const SLICE_FRAGMENT = `
in vec3 vAt;
uniform float uIsovalue, uBand;
out vec4 outColor;
${FIELD}${MAPPED}
void main() {
  float value = exact(vAt);
  // Beyond the band a level set only holds the sign: gray inside, and outside nothing to see.
  if (value >= uBand) discard;
  vec3 color = value <= -uBand ? vec3(0.6) : mapped(value);
  float line = abs(value - uIsovalue) / max(fwidth(value), 1e-30);
  outColor = vec4(mix(color, vec3(0.0), uBand < 3e38 ? 1.0 - smoothstep(0.7, 1.6, line) : 0.0), 1.0);
}`;

const BLOCK = 8;
const AXES = ["x", "y", "z"];
// Share of the box's longest side over which the densest fog hides most of what is behind it, at density 1.
const FOG_DEPTH = 0.05;

const byColumns = (m) => m.map((_, i) => m[4 * (i % 4) + (i >> 2)]);

// Least and greatest value of blocks of 8 voxels, with those that interpolation in them reads.
function blockRanges(half, table, [nx, ny, nz], scale) {
  const counts = [nx, ny, nz].map((n) => Math.max(1, Math.ceil((n - 1) / BLOCK)));
  const ranges = new Float32Array(2 * counts[0] * counts[1] * counts[2]);
  let at = 0;
  for (let z = 0; z < counts[2]; z++)
    for (let y = 0; y < counts[1]; y++)
      for (let x = 0; x < counts[0]; x++, at += 2) {
        let low = Infinity, high = -Infinity;
        for (let k = BLOCK * z; k <= Math.min(BLOCK * (z + 1), nz - 1); k++)
          for (let j = BLOCK * y; j <= Math.min(BLOCK * (y + 1), ny - 1); j++) {
            const row = nx * (j + ny * k), last = row + Math.min(BLOCK * (x + 1), nx - 1);
            for (let i = row + BLOCK * x; i <= last; i++) {
              const value = table[half[i]];
              if (value < low) low = value;
              if (value > high) high = value;
            }
          }
        ranges[at] = low * scale;
        ranges[at + 1] = high * scale;
      }
  return { counts, ranges };
}

async function readVolume(gl, record, scene) {
  const half = await unpack(record.values), size = record.shape, most = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
  if (Math.max(...size) > most) throw new Error(`this browser's volumes have at most ${most} voxels a side`);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  const field = texture(gl, 2, gl.TEXTURE_3D, gl.LINEAR);
  gl.texImage3D(gl.TEXTURE_3D, 0, gl.R16F, ...size, 0, gl.RED, gl.HALF_FLOAT, half);
  const table = halfTable(), { counts, ranges } = blockRanges(half, table, size, record.scale);
  const blocks = texture(gl, 3, gl.TEXTURE_3D, gl.NEAREST);
  gl.texImage3D(gl.TEXTURE_3D, 0, gl.RG32F, ...counts, 0, gl.RG, gl.FLOAT, ranges);
  const model = byColumns(record.matrix), toIndex = inverse(model);
  const isLevelSet = record.class === "level set";
  const toLocal = [0, 1, 2, 4, 5, 6, 8, 9, 10].map((i) => model[i]);
  const sides = AXES.map((_, k) => length(toLocal.slice(3 * k, 3 * k + 3)) * (size[k] - 1));
  return {
    ...record, half, table, field, blocks, size, model, toIndex, toLocal, isLevelSet,
    // Normals turn by the transpose of the inverse.
    toNormal: [0, 4, 8, 1, 5, 9, 2, 6, 10].map((i) => toIndex[i]),
    thickness: 3 / (FOG_DEPTH * Math.max(...sides)),
    look: {
      draw: isLevelSet ? "surface" : "fog", isovalue: isLevelSet ? 0 : 0.5 * (record.from + record.to), density: 0.3,
      slices: [null, null, null], color: "#b9c4cf", by: "field", from: record.from, to: record.to,
      range: [record.low, record.high],
      map: isLevelSet ? scene.diverging : scene.colormap,
    },
  };
}

// The field at an index position, interpolated as on the GPU; null outside.
function fieldAt(object, at) {
  const [nx, ny, nz] = object.size, low = [0, 0, 0], w = [0, 0, 0];
  for (let k = 0; k < 3; k++) {
    if (!(at[k] >= -1e-6 && at[k] <= object.size[k] - 1 + 1e-6)) return null;
    low[k] = clamp(Math.floor(at[k]), 0, Math.max(object.size[k] - 2, 0));
    w[k] = clamp(at[k] - low[k], 0, 1);
  }
  let sum = 0;
  for (let corner = 0; corner < 8; corner++) {
    const [i, j, k] = [corner & 1, (corner >> 1) & 1, corner >> 2];
    const share = (i ? w[0] : 1 - w[0]) * (j ? w[1] : 1 - w[1]) * (k ? w[2] : 1 - w[2]);
    if (share) sum += share * object.table[object.half[low[0] + i + nx * (low[1] + j + ny * (low[2] + k))]];
  }
  return sum * object.scale;
}

function volumeValues(object, shared) {
  return {
    ...shared, uModel: object.model, uSize: object.size, uScale: object.scale, uField: 2, uBlocks: 3,
    uEyeIndex: apply(object.toIndex, shared.uEye), uIsovalue: object.look.isovalue, uColor: rgb(object.look.color),
    uToNormal: object.toNormal, uToLocal: object.toLocal, uMap: shared.mapRow(object.look.map),
    uFrom: object.look.from, uTo: object.look.to,
  };
}

function bindVolume(gl, object) {
  for (const [unit, made] of [[2, object.field], [3, object.blocks]]) {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_3D, made);
  }
}

// What of a volume hides what is behind it: its surface and its slices.
function drawVolume(gl, programs, shapes, object, shared) {
  bindVolume(gl, object);
  const values = volumeValues(object, shared);
  if (object.look.draw === "surface") {
    use(gl, programs.iso, { ...values, uStep: shared.moving ? 1 : 0.5 });
    drawBox(gl, shapes);
  }
  object.look.slices.forEach((share, axis) => {
    if (share === null) return;
    const band = object.isLevelSet ? 0.999 * object.scale : 3.4e38;
    use(gl, programs.slice, { ...values, uAt: share, uAxis: axis, uBand: band });
    gl.bindVertexArray(shapes.square);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  });
  gl.bindVertexArray(null);
}

function drawFog(gl, programs, shapes, object, shared, fromClip) {
  bindVolume(gl, object);
  use(gl, programs.fog, {
    ...volumeValues(object, shared), uStep: shared.moving ? 1.5 : 0.7, uDepth: 1,
    uFromClip: product(object.toIndex, fromClip), uDensity: object.look.density * object.thickness,
  });
  gl.enable(gl.BLEND);
  gl.disable(gl.DEPTH_TEST);
  drawBox(gl, shapes);
  gl.enable(gl.DEPTH_TEST);
  gl.disable(gl.BLEND);
}

// The far sides, which are there also for a viewer in the box.
function drawBox(gl, shapes) {
  gl.enable(gl.CULL_FACE);
  gl.cullFace(gl.FRONT);
  gl.bindVertexArray(shapes.box);
  gl.drawArrays(gl.TRIANGLES, 0, 36);
  gl.bindVertexArray(null);
  gl.disable(gl.CULL_FACE);
}
