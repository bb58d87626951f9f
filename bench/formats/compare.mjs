// Reads scenes as columns and compares them splat by splat.

import { readFileSync } from "node:fs";

/** Columns of a binary little-endian PLY of floats. */
export function readPly(path) {
  const bytes = readFileSync(path);
  const end = bytes.indexOf("end_header\n") + 11;
  const lines = bytes.subarray(0, end).toString().split("\n");
  const count = Number(lines.find((line) => line.startsWith("element vertex")).split(" ")[2]);
  const names = lines.filter((line) => line.startsWith("property float ")).map((line) => line.split(" ")[2]);
  const view = new DataView(bytes.buffer, bytes.byteOffset + end);
  const columns = Object.fromEntries(names.map((name) => [name, new Float32Array(count)]));
  for (let i = 0, at = 0; i < count; i += 1) {
    for (const name of names) {
      columns[name][i] = view.getFloat32(at, true);
      at += 4;
    }
  }
  return { count, columns };
}

/** For each splat of a, the index of the nearest splat of b by position and, among neighbours, by colour and size; -1 for none. */
function matches(a, b) {
  const cells = new Map();
  const size = 0.02;
  const key = (x, y, z) => `${x},${y},${z}`;
  const cell = ({ columns: { x, y, z } }, i) => [x[i], y[i], z[i]].map((v) => Math.floor(v / size));
  for (let i = 0; i < b.count; i += 1) {
    const at = key(...cell(b, i));
    if (!cells.has(at)) cells.set(at, []);
    cells.get(at).push(i);
  }
  const names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "scale_0", "scale_1", "scale_2"];
  const weights = [300, 300, 300, 1, 1, 1, 0.3, 0.3, 0.3];
  const found = new Int32Array(a.count).fill(-1);
  for (let i = 0; i < a.count; i += 1) {
    const [cx, cy, cz] = cell(a, i);
    let best = Infinity;
    for (let dx = -1; dx <= 1; dx += 1) {
      for (let dy = -1; dy <= 1; dy += 1) {
        for (let dz = -1; dz <= 1; dz += 1) {
          for (const j of cells.get(key(cx + dx, cy + dy, cz + dz)) ?? []) {
            const distance = names.reduce((sum, name, k) => sum + (weights[k] * (a.columns[name][i] - b.columns[name][j])) ** 2, 0);
            if (distance < best) [best, found[i]] = [distance, j];
          }
        }
      }
    }
  }
  return found;
}

const sigmoid = (v) => 1 / (1 + Math.exp(-v));

/** Mean and largest differences of two scenes, as text; throws where counts differ. */
export function compare(a, b) {
  if (a.count !== b.count) throw new Error(`${b.count} splats instead of ${a.count}`);
  const found = matches(a, b);
  const rest = Object.keys(b.columns).filter((name) => name.startsWith("f_rest_"));
  const same = rest.length === Object.keys(a.columns).filter((name) => name.startsWith("f_rest_")).length;
  const groups = {
    position: { names: ["x", "y", "z"], of: (v) => v },
    colour: { names: ["f_dc_0", "f_dc_1", "f_dc_2"], of: (v) => v * 0.2820948 },
    opacity: { names: ["opacity"], of: sigmoid },
    "ln size": { names: ["scale_0", "scale_1", "scale_2"], of: (v) => v },
    ...(same && rest.length > 0 ? { harmonics: { names: rest, of: (v) => v } } : {}),
  };
  const lost = found.reduce((sum, j) => sum + (j < 0 ? 1 : 0), 0);
  const parts = Object.entries(groups).map(([group, { names, of }]) => {
    let [sum, most] = [0, 0];
    for (let i = 0; i < a.count; i += 1) {
      if (found[i] < 0) continue;
      for (const name of names) {
        const difference = Math.abs(of(a.columns[name][i]) - of(b.columns[name][found[i]]));
        sum += difference;
        most = Math.max(most, difference);
      }
    }
    return `${group} ${(sum / a.count / names.length).toExponential(1)} (${most.toExponential(1)})`;
  });
  return `${a.count} splats${lost ? `, ${lost} without a counterpart` : ""}; ${parts.join(", ")}`;
}
