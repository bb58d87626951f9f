// Reads compact splats as they arrive: block by block, most important first. The format is that of crates/viewer/src/compact.rs.

const HEADER = 32;
const CORE = 32;

/** @typedef {{ count: number, degree: number, block: number }} Header */
/** @typedef {{ first: number, count: number, cores: Uint8Array<ArrayBuffer>, bands: Uint8Array<ArrayBuffer> }} Block */

/** @param {Response} response @param {(header: Header) => void} begin @param {(block: Block) => void} each */
export async function readSplats(response, begin, each) {
  if (!response.ok || !response.body) throw new Error(`the splats cannot be loaded: ${response.status}`);
  const reader = response.body.getReader();
  /** @type {Header | null} */
  let header = null;
  let first = 0;
  let buffer = new Uint8Array(1 << 20);
  let filled = 0;
  for (;;) {
    const wanted = header ? blockBytes(header, first) : HEADER;
    if (filled >= wanted) {
      if (!header) {
        header = readHeader(buffer);
        begin(header);
      } else {
        const count = Math.min(header.block, header.count - first);
        const cores = buffer.slice(0, count * CORE);
        each({ first, count, cores, bands: buffer.slice(count * CORE, wanted) });
        first += count;
      }
      buffer.copyWithin(0, wanted, filled);
      filled -= wanted;
      if (header && first >= header.count) return;
      continue;
    }
    const { done, value } = await reader.read();
    if (done) throw new Error("the splats ended early");
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
  if (view.getUint32(0, true) !== 0x31535249) throw new Error("these are no splats");
  return { count: view.getUint32(4, true), degree: view.getUint32(8, true), block: view.getUint32(12, true) };
}

/** @param {Header} header @param {number} first */
function blockBytes({ count, degree, block }, first) {
  return Math.min(block, count - first) * (CORE + 16 * degree);
}
