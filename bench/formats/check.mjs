// Checks that other programs read what irradia writes, and vice versa: npm install; node check.mjs IRRADIA SCENE.ply
//
// Every format that splat-transform reads is written by irradia, converted to PLY by splat-transform, and compared with the scene
// splat by splat; every format that it writes is read back by irradia. glb, which splat-transform only writes, is compared with its own.

import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync, statSync } from "node:fs";
import { tmpdir } from "node:os";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { compare, readPly } from "./compare.mjs";

const [irradia, scene] = process.argv.slice(2);
if (!scene) {
  console.error("usage: node check.mjs IRRADIA SCENE.ply");
  process.exit(2);
}
const here = dirname(fileURLToPath(import.meta.url));
const cli = join(process.env.NODE_MODULES ?? join(here, "node_modules"), "@playcanvas/splat-transform/bin/cli.mjs");
const folder = mkdtempSync(join(tmpdir(), "irradia-formats-"));
const ours = (...files) => execFileSync(irradia, ["convert", ...files], { encoding: "utf8" });
const theirs = (...files) => execFileSync(process.execPath, [cli, "-q", "-w", "-g", "cpu", ...files], { encoding: "utf8" });

/** The attributes of a .glb file of floats, by name. */
function readGlb(path) {
  const bytes = readFileSync(path);
  const length = bytes.readUInt32LE(12);
  const document = JSON.parse(bytes.subarray(20, 20 + length).toString());
  const binary = bytes.subarray(28 + length);
  const { attributes } = document.meshes[0].primitives[0];
  return Object.fromEntries(
    Object.entries(attributes).map(([name, index]) => {
      const accessor = document.accessors[index];
      const view = document.bufferViews[accessor.bufferView];
      return [name, binary.subarray(view.byteOffset ?? 0, (view.byteOffset ?? 0) + view.byteLength)];
    }),
  );
}

/** Covariances of splats, each divided by the square of its largest size. @param {Float32Array} q x, y, z, w @param {Float32Array} s */
function covariances(q, s) {
  const all = [];
  for (let i = 0; i < s.length / 3; i += 1) {
    const length = Math.hypot(...q.subarray(4 * i, 4 * i + 4)) || 1;
    const [x, y, z, w] = Array.from(q.subarray(4 * i, 4 * i + 4), (v) => v / length);
    const rows = [
      [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ];
    const sizes = s.subarray(3 * i, 3 * i + 3);
    const largest = Math.max(...sizes) || 1;
    for (let a = 0; a < 3; a += 1) for (let b = a; b < 3; b += 1) all.push([0, 1, 2].reduce((sum, k) => sum + rows[a][k] * rows[b][k] * (sizes[k] / largest) ** 2, 0));
  }
  return all;
}

let failed = 0;
const check = (title, run) => {
  try {
    console.log(`${title}: ${run()}`);
  } catch (error) {
    failed += 1;
    console.log(`${title}: FAILED ${error.message.split("\n")[0]}`);
  }
};
const megabytes = (path) => `${(statSync(path).size / 1e6).toFixed(2)} MB`;

const plain = join(folder, "plain.ply");
ours(scene, plain);
const truth = readPly(plain);
console.log("written by irradia, read by splat-transform; mean difference (largest)");
const kinds = [
  ["a.ply"],
  ["a.compressed.ply"],
  ["a.spz"],
  ["b.spz", "--spz-version", "4"],
  ["a.splat"],
  ["a.ksplat"],
  ["b.ksplat", "--quality", "high"],
  ["c.ksplat", "--quality", "low"],
  ["a.sog"],
];
for (const [name, ...options] of kinds) {
  check(`${name.slice(1)} ${options.join(" ")}`, () => {
    const [file, back] = [join(folder, name), join(folder, "back.ply")];
    ours(plain, file, "--no-compare", ...options);
    theirs(file, back);
    return `${megabytes(file)}; ${compare(truth, readPly(back))}`;
  });
}
check("glb, beside splat-transform's", () => {
  const [a, b] = [join(folder, "ours.glb"), join(folder, "theirs.glb")];
  ours(plain, a, "--no-compare");
  theirs(plain, b);
  const [mine, other] = [readGlb(a), readGlb(b)];
  const names = Object.keys(mine);
  const floats = (buffer) => new Float32Array(buffer.buffer.slice(buffer.byteOffset, buffer.byteOffset + buffer.byteLength));
  const [rotation, size] = ["ROTATION", "SCALE"].map((name) => `KHR_gaussian_splatting:${name}`);
  const worst = names.filter((name) => name !== rotation).map((name) => {
    const [p, q] = [floats(mine[name]), floats(other[name])];
    if (p.length !== q.length) throw new Error(`${name} has ${p.length} numbers instead of ${q.length}`);
    return p.reduce((most, v, i) => Math.max(most, Math.abs(v - q[i])), 0);
  });
  // A Gaussian has several rotations: what must agree is its covariance.
  const shapes = [mine, other].map((file) => covariances(floats(file[rotation]), floats(file[size])));
  const shape = shapes[0].reduce((most, v, i) => Math.max(most, Math.abs(v - shapes[1][i])), 0);
  return `${names.length} attributes, the largest difference ${Math.max(...worst).toExponential(1)}, of covariances by the largest size squared ${shape.toExponential(1)}`;
});
console.log("written by splat-transform, read by irradia");
for (const name of ["t.compressed.ply", "t.spz", "t.sog", "t.glb"]) {
  check(name.slice(1), () => {
    const [file, back] = [join(folder, name), join(folder, "back.ply")];
    theirs(plain, file);
    ours(file, back);
    return `${megabytes(file)}; ${compare(truth, readPly(back))}`;
  });
}
rmSync(folder, { recursive: true });
process.exit(failed ? 1 : 0);
