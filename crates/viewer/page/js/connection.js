// The socket: requests to the server, pictures and news from it. Reconnects by itself.

import { state } from "./state.js";

/** @typedef {{ id: number, width: number, height: number, sharp: boolean, version: number, milliseconds: number,
 *   range?: [number, number] }} Header */

/** Milliseconds until the next attempt to connect: the first wait, doubled up to the last one. */
const MIN_WAIT = 250;
const MAX_WAIT = 4000;

class Connection extends EventTarget {
  /** @type {WebSocket | null} */
  socket = null;
  wait = MIN_WAIT;
  /** @type {Map<string, (answer: any) => void>} */
  awaited = new Map();
  tags = 0;

  open() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket${location.search}`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = (event) => this.receive(event.data);
    socket.onclose = (event) => {
      this.socket = null;
      const full = event.code === 1013;
      state.set({ connection: full ? "full" : "lost" });
      setTimeout(() => this.open(), this.wait);
      this.wait = Math.min(2 * this.wait, MAX_WAIT);
    };
    this.socket = socket;
  }

  /** @param {object} request */
  send(request) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(request));
  }

  /** Asks what is at a pixel of a shot; null when there is no answer.
   * @param {object} shot @param {number} x @param {number} y @returns {Promise<any>} */
  pick(shot, x, y) {
    const tag = `${(this.tags += 1)}`;
    this.send({ do: "pick", tag, x, y, shot });
    return new Promise((resolve) => {
      this.awaited.set(tag, resolve);
      setTimeout(() => this.awaited.delete(tag) && resolve(null), 8000);
    });
  }

  /** @param {string | ArrayBuffer} data */
  receive(data) {
    if (data instanceof ArrayBuffer) {
      const length = new DataView(data).getUint32(0, true);
      /** @type {Header} */
      const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
      const jpeg = new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" });
      this.dispatchEvent(new CustomEvent("picture", { detail: { header, jpeg } }));
      return;
    }
    const told = JSON.parse(data);
    switch (told.tell) {
      case "hello":
        // Another server at the same address may have another scene.
        if ((state.get("hello")?.id ?? told.id) !== told.id) return location.reload();
        // Not before the greeting: a server with too many pages accepts a socket only to close it.
        this.wait = MIN_WAIT;
        // A scale that the server cannot keep stays.
        state.set({
          connection: "open", hello: told, views: told.views, metres: told.metres ?? state.get("metres"),
          ...(told.scene && { scene: told.scene }),
        });
        this.dispatchEvent(new Event("open"));
        break;
      case "scene":
        state.set({ scene: told });
        break;
      case "train":
        state.set({ train: merged(state.get("train"), told) });
        break;
      case "picked":
        this.awaited.get(told.tag)?.(told);
        this.awaited.delete(told.tag);
        break;
      case "score":
        state.set({ scores: new Map(state.get("scores")).set(told.view, told.psnr) });
        break;
      case "editing":
        state.set({ editing: told });
        break;
      case "unit":
        state.set({ metres: told.metres });
        break;
      case "problem":
        state.set({ problem: told.text });
        break;
    }
  }
}

/** News of a training, completed by the points of its curves that are known already. @param {any} old @param {any} fresh */
function merged(old, fresh) {
  const before = old ? old.curve.slice(0, fresh.from) : [];
  return { ...fresh, curve: [...before, ...fresh.curve] };
}

export const connection = new Connection();

/** The address of a photograph or thumbnail of a view. It identifies the scene, so that the browser may cache it.
 * @param {number} index @param {"photo" | "thumbnail"} kind */
export const pictureOf = (index, kind) => `view/${index}/${kind}${location.search ? `${location.search}&` : "?"}scene=${state.get("hello")?.id ?? ""}`;
