// Weights drawn at random in place of a network's own, for a graph that is only timed (memmlp.live.web.weightless_files).

const BYTES = { float32: 4, float16: 2, int8: 1 };
const ROOT3 = Math.sqrt(3); // a uniform number between -1 and 1 has the standard deviation 1 / sqrt(3)

// parts: [{ offset, size, kind, scale }]; returns the bytes of all of them, or null for none.
export function drawn(parts) {
  if (!parts.length) return null;
  const last = parts.at(-1);
  const bytes = new ArrayBuffer(last.offset + BYTES[last.kind] * last.size);
  const random = uniform(1);
  for (const { offset, size, kind, scale } of parts) fill[kind](bytes, offset, size, () => ROOT3 * scale * random());
  return new Uint8Array(bytes);
}

const fill = {
  float32(bytes, offset, count, next) {
    const array = new Float32Array(bytes, offset, count);
    for (let i = 0; i < count; i++) array[i] = next();
  },
  float16(bytes, offset, count, next) {
    const array = new Uint16Array(bytes, offset, count);
    for (let i = 0; i < count; i++) array[i] = half(next());
  },
  int8(bytes, offset, count, next) {
    const array = new Int8Array(bytes, offset, count);
    for (let i = 0; i < count; i++) array[i] = Math.max(-127, Math.min(127, Math.round(next())));
  },
};

// Numbers between -1 and 1, the same ones for the same seed (mulberry32).
function uniform(seed) {
  let state = seed;
  return () => {
    state = (state + 0x6d2b79f5) | 0;
    let t = Math.imul(state ^ (state >>> 15), 1 | state);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 2147483648 - 1;
  };
}

const WORD = new Float32Array(1);
const BITS = new Uint32Array(WORD.buffer);

// The 16 bits of a number in half precision, cut off; what is too small for it becomes 0.
function half(value) {
  WORD[0] = value;
  const sign = (BITS[0] >>> 16) & 0x8000;
  const exponent = ((BITS[0] >>> 23) & 0xff) - 112;
  return exponent <= 0 ? sign : sign | (Math.min(exponent, 30) << 10) | ((BITS[0] >>> 13) & 0x3ff);
}
