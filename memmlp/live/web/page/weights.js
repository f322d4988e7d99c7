// Weights drawn at random in place of a network's own, for a graph that is only timed (memmlp.live.web.networks).

const BYTES = { float32: 4, float16: 2, int8: 1 };
const ROOT3 = Math.sqrt(3); // a uniform number between -1 and 1 has the standard deviation 1 / sqrt(3)
const uniform = index => (Math.imul(index + 1, 0x9e3779b1) >>> 0) / 2 ** 31 - 1; // the same numbers for every graph

// parts: [{ offset, size, kind, scale }]; returns the bytes of all of them, or null for none.
export function drawn(parts) {
  if (!parts.length) return null;
  const last = parts.at(-1);
  const bytes = new ArrayBuffer(last.offset + BYTES[last.kind] * last.size);
  for (const { offset, size, kind, scale } of parts) {
    const array = new { float32: Float32Array, float16: Uint16Array, int8: Int8Array }[kind](bytes, offset, size);
    const written = { float32: x => x, float16: half, int8: x => Math.max(-127, Math.min(127, Math.round(x))) }[kind];
    for (let i = 0; i < size; i++) array[i] = written(ROOT3 * scale * uniform(i));
  }
  return new Uint8Array(bytes);
}

const WORD = new Float32Array(1);
const BITS = new Uint32Array(WORD.buffer);

// The 16 bits of a number in half precision, cut off; a number that is too small for it becomes 0.
function half(value) {
  WORD[0] = value;
  const sign = (BITS[0] >>> 16) & 0x8000;
  const exponent = ((BITS[0] >>> 23) & 0xff) - 112;
  return exponent <= 0 ? sign : sign | (Math.min(exponent, 30) << 10) | ((BITS[0] >>> 13) & 0x3ff);
}
