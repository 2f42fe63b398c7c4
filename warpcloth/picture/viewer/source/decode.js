// Reads the arrays of a page, which warpcloth/picture/coding.py has written.

/** The bytes of a base64 text of raw deflate. */
export async function inflate(text) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Rows of k indices, which are stored as the differences between rows. */
export async function indices(text, k) {
  const bytes = await inflate(text);
  const rows = new Int32Array(bytes.buffer, 0, bytes.length / 4);
  for (let i = k; i < rows.length; i++) rows[i] += rows[i - k];
  return rows;
}

/** Codes of positions, 16 bits: of each frame all x, then all y, then all z. */
export async function positions(text, count) {
  const bytes = await inflate(text);
  const size = 3 * count;
  const frames = bytes.length / (2 * size);
  const codes = new Uint16Array(frames * size);
  for (let frame = 0; frame < frames; frame++) {
    const upper = 2 * frame * size;
    const here = frame * size;
    const last = here - size;
    const other = frame > 1 ? last - size : last;
    for (let axis = 0; axis < 3; axis++) {
      let change = 0;
      for (let i = axis * count; i < (axis + 1) * count; i++) {
        const folded = (bytes[upper + i] << 8) | bytes[upper + size + i];
        change += (folded >>> 1) ^ -(folded & 1);
        codes[here + i] = change + (frame ? 2 * codes[last + i] - codes[other + i] : 0);
      }
    }
  }
  return codes;
}

/** Codes of values, 8 bits, of one frame after another. */
export async function values(text, count) {
  const codes = await inflate(text);
  for (let i = count; i < codes.length; i++) codes[i] += codes[i - count];
  return codes;
}
