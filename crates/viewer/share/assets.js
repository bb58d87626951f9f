// Loads the renderer's shaders, worker and splats in a shared page: from the page itself, or from the file beside it.

/** @param {string} id */
const text = (id) => /** @type {HTMLElement} */ (document.getElementById(id)).textContent ?? "";

/** Start camera, background and how the scene is drawn, as the program wrote them. */
export const view = JSON.parse(text("view"));

/** By name. @type {Promise<Record<string, string>>} */
const shaders = unzipped(inside("shaders")).json();

/** @param {string} name */
export const shader = async (name) => (await shaders)[name];

export const orderWorker = () => new Worker(URL.createObjectURL(new Blob([text("order.js")], { type: "text/javascript" })));

/** A shared page has no selection. @returns {Promise<Uint8Array | null>} */
export const openMask = async () => null;

/** The scene in compact form. @param {AbortSignal} signal */
export async function openSplats(signal) {
  return view.file ? fetched(view.file, signal) : unzipped(inside("splats"));
}

/** The unpacked file beside the page. @param {string} file @param {AbortSignal} signal */
async function fetched(file, signal) {
  const response = await fetch(file, { signal }).catch((error) => {
    if (error.name === "AbortError") throw error;
    return null;
  });
  if (!response?.ok) throw new Error(`${file} cannot be loaded: serve this folder, with all its files, from a web server, or share the scene as one page`);
  const bytes = await response.blob();
  const start = new Uint8Array(await bytes.slice(0, 2).arrayBuffer());
  // If the server declares the compression, the browser has already unpacked the file.
  return start[0] === 0x1f && start[1] === 0x8b ? unzipped(bytes.stream()) : new Response(bytes.stream());
}

/** The bytes that the page holds in base64. @param {string} id */
function inside(id) {
  return new Blob(decoded(text(id))).stream();
}

/** @param {ReadableStream} packed */
function unzipped(packed) {
  return new Response(packed.pipeThrough(new DecompressionStream("gzip")));
}

/** The bytes of base64 text, decoded part by part. @param {string} base64 */
function decoded(base64) {
  const part = 4 << 20;
  const parts = [];
  for (let at = 0; at < base64.length; at += part) {
    const binary = atob(base64.slice(at, at + part));
    const bytes = new Uint8Array(binary.length);
    for (let i = 0; i < binary.length; i += 1) bytes[i] = binary.charCodeAt(i);
    parts.push(bytes);
  }
  return parts;
}
