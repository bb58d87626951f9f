// Virtual reality, if the browser offers it, drawn by this page. Tested without a headset, with a simulated session: the button appears if
// a session is offered, and both eyes see the scene (page-tests/tests/xr.test.js).

import { axes, fromAxes } from "./math.js";
import { state } from "./state.js";
import { metresPerUnit } from "./units.js";

/** The parts of WebXR that are used. @typedef {any} Xr */

/** @returns {Promise<boolean>} */
export async function offersXr() {
  try {
    return Boolean(await /** @type {Xr} */ (navigator).xr?.isSessionSupported("immersive-vr"));
  } catch {
    return false;
  }
}

/** @param {import("./stage.js").Stage} stage */
export async function enterXr(stage) {
  const { local } = stage;
  // Only WebGL2 draws for headsets.
  const gl = local?.holdWebGl(true)?.gl;
  if (!local || !gl || !state.get("scene")?.travels) {
    local?.holdWebGl(false);
    state.set({ problem: "VR needs splats, drawn in this browser with WebGL2" });
    return;
  }
  try {
    await /** @type {Xr} */ (gl).makeXRCompatible();
    const session = await /** @type {Xr} */ (navigator).xr.requestSession("immersive-vr");
    const layer = new /** @type {Xr} */ (globalThis).XRWebGLLayer(session, gl);
    session.updateRenderState({ baseLayer: layer });
    const space = await session.requestReferenceSpace("local");
    const start = state.get("camera");
    // If the scale is unknown, one metre is a sixth of the scene's radius.
    const metre = 1 / (metresPerUnit() ?? 6 / (state.get("scene")?.radius ?? 6));
    const frame = (/** @type {number} */ _now, /** @type {Xr} */ now) => {
      session.requestAnimationFrame(frame);
      const pose = now.getViewerPose(space);
      if (!pose) return;
      gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
      gl.clearColor(0, 0, 0, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      for (const view of pose.views) {
        const port = layer.getViewport(view);
        local.eye(layer.framebuffer, port, eyeCamera(start, view.transform, metre), view.projectionMatrix);
      }
    };
    session.requestAnimationFrame(frame);
    session.addEventListener("end", () => {
      local.holdWebGl(false);
      // The last camera was that of an eye.
      stage.dirty = true;
    });
  } catch (error) {
    local.holdWebGl(false);
    state.set({ problem: `VR cannot start: ${error}` });
  }
}

/** The camera of an eye: OpenGL's axes (y up, z backward) of the headset, moved to where the page's camera was.
 * @param {import("./camera.js").Camera} start @param {Xr} transform @param {number} metre world units */
function eyeCamera(start, transform, metre) {
  const [x, y, z] = axes(start.rotation);
  const m = transform.matrix;
  const into = (/** @type {number} */ a, /** @type {number} */ b, /** @type {number} */ c) =>
    /** @type {import("./math.js").Vec3} */ ([0, 1, 2].map((i) => x[i] * a - y[i] * b - z[i] * c));
  const position = into(m[12] * metre, m[13] * metre, m[14] * metre).map((v, i) => v + start.position[i]);
  const rotation = fromAxes(into(m[0], m[1], m[2]), into(-m[4], -m[5], -m[6]), into(-m[8], -m[9], -m[10]));
  return { position: /** @type {import("./math.js").Vec3} */ (position), rotation, fov: start.fov };
}
