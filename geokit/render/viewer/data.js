// Arrays of the page: base64 of raw DEFLATE of byte planes, as geokit/render/viewer/arrays.py writes them.

const TYPES = {
  u1: Uint8Array, i1: Int8Array, u2: Uint16Array, i2: Int16Array, u4: Uint32Array, i4: Int32Array, f4: Float32Array,
};

async function unpack(array) {
  const element = document.getElementById(`array-${array.id}`);
  let bytes = bytesOf(element.textContent);
  const width = TYPES[array.type].BYTES_PER_ELEMENT;
  if (array.packed) {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
    const planes = new Uint8Array(await new Response(stream).arrayBuffer());
    if (width === 1) {
      bytes = planes;
    } else {
      const count = planes.length / width;
      bytes = new Uint8Array(planes.length);
      for (let plane = 0; plane < width; plane++) {
        const from = plane * count;
        for (let i = 0, to = plane; i < count; i++, to += width) bytes[to] = planes[from + i];
      }
    }
  }
  const values = new TYPES[array.type](bytes.buffer, 0, bytes.length / width);
  if (array.differences) for (let i = 1; i < values.length; i++) values[i] += values[i - 1];
  return values;
}

function bytesOf(text) {
  const padding = text.endsWith("==") ? 2 : text.endsWith("=") ? 1 : 0;
  const bytes = new Uint8Array((text.length / 4) * 3 - padding);
  // Piece by piece: atob of all would double the memory. A multiple of 4 characters each.
  const step = 1 << 20;
  for (let from = 0, to = 0; from < text.length; from += step) {
    const piece = atob(text.slice(from, from + step));
    for (let i = 0; i < piece.length; i++) bytes[to++] = piece.charCodeAt(i);
  }
  return bytes;
}

// Values of all half floats.
function halfTable() {
  const table = new Float32Array(65536);
  for (let bits = 0; bits < 65536; bits++) {
    const exponent = (bits >> 10) & 31, fraction = bits & 1023, sign = bits & 32768 ? -1 : 1;
    table[bits] = sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
  }
  return table;
}

// Seven digits: what float32 holds.
function shown(value) {
  return Number.isFinite(value) ? String(Number(Number(value).toPrecision(7))) : String(value);
}
