// Scenes for the tests: trained in a moment, or written here.

import { cpSync, existsSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { run, scratch } from "./harness.js";

const shared = join(import.meta.dirname, "../../../../../shared/data");

/** A dataset of the demo scene. */
export function dataset() {
  const data = join(scratch, "data");
  if (!existsSync(data)) run("synth", data, "--views", "24", "--size", "160x120");
  return data;
}

/** A run on it, over black as a splat file without a run is shown. */
export function trained() {
  const out = join(scratch, "run");
  if (!existsSync(out)) run("train", dataset(), "--out", out, "--steps", "400", "--background", "black");
  return out;
}

/** A run whose view `dark` was exposed to half the light of the others. @param {number} views @param {number} dark */
export function lit(views, dark) {
  const out = join(scratch, "lit");
  if (existsSync(out)) return out;
  cpSync(trained(), out, { recursive: true });
  const identity = [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0];
  const maps = Array.from({ length: views }, (_, view) => identity.map((value) => (view === dark ? 0.5 * value : value))).flat();
  const header = Buffer.from(JSON.stringify({ maps: { dtype: "F32", shape: [views, 12], data_offsets: [0, 4 * maps.length] } }));
  const length = Buffer.alloc(8);
  length.writeBigUInt64LE(BigInt(header.length));
  writeFileSync(join(out, "exposure.safetensors"), Buffer.concat([length, header, Buffer.from(new Float32Array(maps).buffer)]));
  return out;
}

/** A run with a radiance field. */
export function field() {
  const out = join(scratch, "field");
  if (!existsSync(out)) run("train", dataset(), "--out", out, "--steps", "40", "--recipe", "hashgrid");
  return out;
}

/** A run whose splats have a residual field. */
export function shiny() {
  const out = join(scratch, "shiny");
  if (!existsSync(out)) run("train", dataset(), "--out", out, "--steps", "100", "--recipe", "shiny");
  return out;
}

/** A run on photographs, if they exist. */
export function fox() {
  if (!existsSync(join(shared, "fox_colmap"))) return null;
  const out = join(scratch, "fox");
  if (!existsSync(out)) run("train", join(shared, "fox_colmap"), "--out", out, "--steps", "300", "--downscale", "4");
  return out;
}

/** Random splats of every size, shape, opacity and colour, with harmonics of degree 3. @param {number} count */
export function random(count) {
  const file = join(scratch, `random_${count}.ply`);
  let seed = 7;
  const uniform = () => {
    seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
    return seed / 2 ** 32;
  };
  const normal = () => Math.sqrt(-2 * Math.log(uniform() + 1e-9)) * Math.cos(2 * Math.PI * uniform());
  const rest = Array.from({ length: 45 }, (_, i) => `f_rest_${i}`);
  const names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", ...rest, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
  const values = new Float32Array(count * names.length);
  const size = Math.log(1.2 / Math.cbrt(count));
  for (let i = 0, at = 0; i < count; i += 1) {
    for (let c = 0; c < 3; c += 1) values[at++] = normal();
    for (let c = 0; c < 3; c += 1) values[at++] = 1.2 * normal();
    for (let c = 0; c < 45; c += 1) values[at++] = 0.15 * normal();
    values[at++] = 1.5 * normal();
    for (let c = 0; c < 3; c += 1) values[at++] = size + 0.7 * normal();
    for (let c = 0; c < 4; c += 1) values[at++] = normal();
  }
  const header = `ply\nformat binary_little_endian 1.0\nelement vertex ${count}\n${names.map((name) => `property float ${name}\n`).join("")}end_header\n`;
  writeFileSync(file, Buffer.concat([Buffer.from(header), Buffer.from(values.buffer)]));
  return file;
}
