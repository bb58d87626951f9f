// Where the renderer's shaders, worker and splats come from: the server. A shared page has its own file of this name.

/** @param {string} name */
export const shader = async (name) => (await fetch(`page/shaders/${name}${location.search}`)).text();

export const orderWorker = () => new Worker(`page/js/local/order.js${location.search}`, { type: "module" });

/** The scene in compact form. @param {AbortSignal} signal */
export const openSplats = (signal) => fetch(`splats${location.search}`, { signal });
