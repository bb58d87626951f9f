// Loads the renderer's shaders, worker and splats from the server. A shared page has its own file of this name.

/** @param {string} name */
export const shader = async (name) => (await fetch(`page/shaders/${name}${location.search}`)).text();

export const orderWorker = () => new Worker(`page/js/local/order.js${location.search}`, { type: "module" });

/** Which splats of a version are selected, a bit each in the order of the compact form; null if that is not known yet.
 * @param {number} version @returns {Promise<Uint8Array | null>} */
export async function openMask(version) {
  const response = await fetch(`selection/${version}${location.search}`);
  return response.ok ? new Uint8Array(await response.arrayBuffer()) : null;
}

/** The scene in compact form. @param {AbortSignal} signal */
export const openSplats = (signal) => fetch(`splats${location.search}`, { signal });
