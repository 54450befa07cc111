// What a ray hits, and the values there. It is computed here and not read back from a picture: positions are exact.

// The nearest hit of visible objects: { object, along, at, lines } or null. A pixel spans `spread` at distance 1.
function pick(objects, ray, spread) {
  let best = null;
  const fog = [];
  for (const object of objects) {
    if (!object.visible) continue;
    const found = object.kind === "mesh" ? pickMesh(object, ray)
      : object.kind === "cloud" ? pickCloud(object, ray, spread) : pickVolume(object, ray);
    if (found && (!best || found.along < best.along)) best = { object, ...found };
    if (object.kind === "volume" && object.look.draw === "fog") fog.push(object);
  }
  if (!best) {
    for (const object of fog) {
      const found = pickFog(object, ray);
      if (found && (!best || found.value > best.value)) best = { object, ...found };
    }
  }
  if (best) best.at = plus(ray.origin, ray.direction, best.along);
  return best;
}

function pickMesh({ vertices, faces, attributes }, { origin, direction }) {
  const [ox, oy, oz] = origin, [dx, dy, dz] = direction;
  let best = Infinity, face = -1, at = null;
  for (let i = 0; i < faces.length; i += 3) {
    const a = 3 * faces[i], b = 3 * faces[i + 1], c = 3 * faces[i + 2];
    const ax = vertices[a], ay = vertices[a + 1], az = vertices[a + 2];
    const ux = vertices[b] - ax, uy = vertices[b + 1] - ay, uz = vertices[b + 2] - az;
    const vx = vertices[c] - ax, vy = vertices[c + 1] - ay, vz = vertices[c + 2] - az;
    const px = dy * vz - dz * vy, py = dz * vx - dx * vz, pz = dx * vy - dy * vx;
    const volume = ux * px + uy * py + uz * pz;
    if (volume === 0) continue;
    const sx = ox - ax, sy = oy - ay, sz = oz - az, u = (sx * px + sy * py + sz * pz) / volume;
    if (u < 0 || u > 1) continue;
    const qx = sy * uz - sz * uy, qy = sz * ux - sx * uz, qz = sx * uy - sy * ux;
    const v = (dx * qx + dy * qy + dz * qz) / volume;
    if (v < 0 || u + v > 1) continue;
    const along = (vx * qx + vy * qy + vz * qz) / volume;
    if (along > 1e-6 && along < best) [best, face, at] = [along, i / 3, [1 - u - v, u, v]];
  }
  if (face < 0) return null;
  const near = at.indexOf(Math.max(...at));
  const lines = attributes.map((attribute) => {
    const { values } = attribute, rows = [0, 1, 2].map((k) => rowOf(attribute.at, faces, 3 * face + k));
    // Whole numbers may be labels: that of the nearest corner.
    const isWhole = !(values instanceof Float32Array);
    return [labelOf(attribute), isWhole ? values[rows[near]] : at.reduce((sum, w, k) => sum + w * values[rows[k]], 0)];
  });
  const corners = [0, 1, 2].map((k) => faces[3 * face + k]);
  return { along: best, id: face, lines: [["triangle", face], ["vertices", corners.join(", ")], ...lines] };
}

const labelOf = (attribute) => (attribute.vector ? `|${attribute.name}|` : attribute.name);

function pickCloud({ vertices, attributes, look }, { origin, direction }, spread) {
  const [ox, oy, oz] = origin, [dx, dy, dz] = direction, radius = Math.max(0.5 * look.pointSize, 3) * spread;
  let best = Infinity, point = -1;
  for (let i = 0; i < vertices.length; i += 3) {
    const x = vertices[i] - ox, y = vertices[i + 1] - oy, z = vertices[i + 2] - oz;
    const along = x * dx + y * dy + z * dz;
    if (along <= 1e-6 || along >= best) continue;
    if (x * x + y * y + z * z - along * along <= (radius * along) ** 2) [best, point] = [along, i / 3];
  }
  if (point < 0) return null;
  const lines = attributes.map((attribute) => [labelOf(attribute), attribute.values[point]]);
  const exact = [0, 1, 2].map((k) => vertices[3 * point + k]);
  return { along: best, exact, id: point, lines: [["point", point], ...lines] };
}

// The ray in indices, and where it is in the box; distances are those along the ray itself.
function indexRay({ toIndex, size }, { origin, direction }) {
  const from = apply(toIndex, origin), along = apply(toIndex, direction, 0);
  let near = 0, far = Infinity;
  for (let k = 0; k < 3; k++) {
    const a = -from[k] / along[k], b = (size[k] - 1 - from[k]) / along[k];
    if (along[k] === 0) {
      if (from[k] < 0 || from[k] > size[k] - 1) far = -1;
    } else {
      [near, far] = [Math.max(near, Math.min(a, b)), Math.min(far, Math.max(a, b))];
    }
  }
  return { from, along, near, far, step: 0.25 / length(along), at: (t) => plus(from, along, t) };
}

function pickVolume(object, ray) {
  const inner = indexRay(object, ray), { look } = object;
  let best = Infinity;
  if (look.draw === "surface") {
    let before = null;
    for (let t = inner.near; t <= inner.far; t += inner.step) {
      const now = fieldAt(object, inner.at(t));
      if (now === null) continue;
      if (before !== null && now - look.isovalue < 0 !== before - look.isovalue < 0) {
        let [a, b] = [t - inner.step, t];
        for (let k = 0; k < 30; k++) {
          const middle = 0.5 * (a + b), value = fieldAt(object, inner.at(middle));
          if (value - look.isovalue < 0 === before - look.isovalue < 0) a = middle; else b = middle;
        }
        best = 0.5 * (a + b);
        break;
      }
      before = now;
    }
  }
  look.slices.forEach((share, axis) => {
    if (share === null || inner.along[axis] === 0) return;
    const t = (share * (object.size[axis] - 1) - inner.from[axis]) / inner.along[axis];
    if (t > 1e-6 && t >= inner.near - 1e-9 && t <= inner.far + 1e-9) best = Math.min(best, t);
  });
  if (best === Infinity) return null;
  return { along: best, lines: [["value", fieldAt(object, inner.at(best)) ?? NaN]] };
}

// Where the fog is densest along the ray.
function pickFog(object, ray) {
  const inner = indexRay(object, ray);
  let value = object.look.from, along = null;
  for (let t = inner.near; t <= inner.far; t += inner.step) {
    const now = fieldAt(object, inner.at(t));
    if (now !== null && now > value) [value, along] = [now, t];
  }
  return along === null ? null : { along, value, lines: [["greatest value", value]] };
}
