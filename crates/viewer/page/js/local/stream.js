// Reads compact splats as they arrive: block by block, most important first, and the levels of detail after the scene. The format is
// that of crates/viewer/src/compact.rs.

const HEADER = 32;
const CORE = 32;

/** counts: splats of the scene, then of its levels. @typedef {{ counts: number[], degree: number, block: number }} Header */
/** level: 0 for the scene. @typedef {{ level: number, first: number, count: number, cores: Uint8Array<ArrayBuffer>, bands: Uint8Array<ArrayBuffer> }} Block */

/** @param {Response} response @param {(header: Header) => void} begin @param {(block: Block) => void} each */
export async function readSplats(response, begin, each) {
  if (!response.ok || !response.body) throw new Error(`the splats cannot be loaded: ${response.status}`);
  const reader = response.body.getReader();
  /** @type {Header | null} */
  let header = null;
  let level = 0;
  let first = 0;
  let buffer = new Uint8Array(1 << 20);
  let filled = 0;
  for (;;) {
    const wanted = header ? blockBytes(header, level, first) : HEADER;
    if (filled >= wanted) {
      if (!header) {
        header = readHeader(buffer);
        begin(header);
      } else {
        const count = Math.min(header.block, header.counts[level] - first);
        const cores = buffer.slice(0, count * CORE);
        each({ level, first, count, cores, bands: buffer.slice(count * CORE, wanted) });
        first += count;
      }
      buffer.copyWithin(0, wanted, filled);
      filled -= wanted;
      while (header && first >= header.counts[level]) {
        [level, first] = [level + 1, 0];
        if (level === header.counts.length) return;
      }
      continue;
    }
    const { done, value } = await reader.read();
    if (done) throw new Error("the data of the splats ended early");
    if (filled + value.length > buffer.length) {
      const larger = new Uint8Array(2 * (filled + value.length));
      larger.set(buffer.subarray(0, filled));
      buffer = larger;
    }
    buffer.set(value, filled);
    filled += value.length;
  }
}

/** @param {Uint8Array} bytes @returns {Header} */
function readHeader(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  if (view.getUint32(0, true) !== 0x31535249) throw new Error("these are not compact splats");
  const word = (/** @type {number} */ at) => view.getUint32(4 * at, true);
  const levels = [4, 5, 6].map(word).filter((count) => count > 0);
  return { counts: [word(1), ...levels], degree: word(2), block: word(3) };
}

/** @param {Header} header @param {number} level @param {number} first */
function blockBytes({ counts, degree, block }, level, first) {
  return Math.min(block, counts[level] - first) * (CORE + 16 * degree);
}
