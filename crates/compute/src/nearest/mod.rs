//! Nearest and second nearest neighbours of 128-byte vectors by inner product, exhaustively and in both directions at once.
//!
//! Products are exact integers and ties go to the lower index, so that every instruction set gives the same result. Columns
//! (vectors of `b`) are in the lanes: a tile of 8 rows by 2 vectors of columns stays in registers over all 128 bytes. A product
//! has at most 23 bits, which leaves 9 of 32 for an index, so that a single maximum updates the best of a lane with its index.

#[cfg(target_arch = "aarch64")]
mod neon;
mod portable;
#[cfg(target_arch = "x86_64")]
mod x86;

use crate::Level;
use portable::Arrays;

/// Bytes of a vector.
pub const BYTES: usize = 128;

/// The neighbour with the largest inner product.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Nearest {
    /// Index of the neighbour; the lowest of several equals.
    pub index: u32,
    /// Its inner product.
    pub product: u32,
    /// The largest inner product of all others; 0 if there are none.
    pub second: u32,
}

impl Nearest {
    /// Before any neighbour is known.
    pub const NONE: Self = Self {
        index: u32::MAX,
        product: 0,
        second: 0,
    };

    /// Merges the neighbour `index`, and others whose products are at most `second`, which is at most `product`.
    pub fn merge(&mut self, index: u32, product: u32, second: u32) {
        if product > self.product || (product == self.product && index < self.index) {
            self.second = second.max(self.product);
            (self.index, self.product) = (index, product);
        } else {
            self.second = self.second.max(product);
        }
    }
}

/// For each vector of `a` its nearest in `b`, and for each of `b` its nearest in `a`. Both are empty if either input is.
pub fn nearest(level: Level, a: &[[u8; BYTES]], b: &[[u8; BYTES]]) -> [Vec<Nearest>; 2] {
    if a.is_empty() || b.is_empty() {
        return [Vec::new(), Vec::new()];
    }
    match level {
        #[cfg(target_arch = "x86_64")]
        Level::Avx512(_) | Level::Avx2(_) => x86::nearest(level, a, b),
        Level::Portable(_) => {
            #[cfg(target_arch = "aarch64")]
            if let Some(neon) = neon::detect() {
                return search(neon, a, b);
            }
            search(Arrays, a, b)
        }
    }
}

/// Bits of a key that hold an index.
const INDEX_BITS: u32 = 9;
const INDEX_MASK: u32 = (1 << INDEX_BITS) - 1;
/// Rows of a register tile.
const TILE: usize = 8;
/// Rows of a block, whose keys stay in cache.
const BLOCK: usize = 256;

/// Vectors of 32-bit integers that hold a word of `STEP` bytes, or a sum of products, per lane.
trait Lanes: Copy {
    type V: Copy;
    const LANES: usize;
    /// Bytes of a vector that a word holds: 4, or 2 widened to 16 bits.
    const STEP: usize;
    /// Whether rows are offset by -128. To compensate, sums of products begin at 128 times the sum of the column.
    const OFFSET_ROWS: bool;
    fn set(self, value: u32) -> Self::V;
    fn load(self, from: &[u32]) -> Self::V;
    fn store(self, v: Self::V, to: &mut [u32]);
    /// `sums` plus, in each lane, the products of its word of `columns` with `row`.
    fn add_products(self, sums: Self::V, columns: Self::V, row: u32) -> Self::V;
    /// `product << INDEX_BITS | index`.
    fn key(self, product: Self::V, index: u32) -> Self::V;
    fn max(self, a: Self::V, b: Self::V) -> Self::V;
    fn min(self, a: Self::V, b: Self::V) -> Self::V;
}

/// Words of `vectors`, `[group][step][member]`, each group padded to `members` with zeros.
fn pack<L: Lanes>(vectors: &[[u8; BYTES]], members: usize, offset: bool) -> Vec<u32> {
    let flip = if offset { 0x80 } else { 0 };
    // By whole words: byte by byte, packing took half as long as a search among a thousand vectors.
    let word = |bytes: &[u8]| match *bytes {
        [a, b] => u32::from(a ^ flip) | u32::from(b ^ flip) << 16,
        [a, b, c, d] => u32::from_le_bytes([a, b, c, d]) ^ u32::from_le_bytes([flip; 4]),
        _ => unreachable!("a step has 2 or 4 bytes"),
    };
    let of_group = members * BYTES / L::STEP;
    let mut words = vec![word(&[0; BYTES][..L::STEP]); vectors.len().div_ceil(members) * of_group];
    for (group, words) in vectors.chunks(members).zip(words.chunks_exact_mut(of_group)) {
        for (member, vector) in group.iter().enumerate() {
            let of_member = words[member..].iter_mut().step_by(members);
            for (to, bytes) in of_member.zip(vector.chunks_exact(L::STEP)) {
                *to = word(bytes);
            }
        }
    }
    words
}

#[inline(always)]
fn search<L: Lanes>(lanes: L, a: &[[u8; BYTES]], b: &[[u8; BYTES]]) -> [Vec<Nearest>; 2] {
    let pair = 2 * L::LANES;
    let steps = BYTES / L::STEP;
    let rows = pack::<L>(a, TILE, L::OFFSET_ROWS);
    let columns = pack::<L>(b, pair, false);
    let mut start = vec![0u32; b.len().next_multiple_of(pair)];
    if L::OFFSET_ROWS {
        for (start, vector) in start.iter_mut().zip(b) {
            *start = 128 * vector.iter().map(|byte| u32::from(*byte)).sum::<u32>();
        }
    }
    let mut of_a = vec![Nearest::NONE; a.len()];
    let mut of_b = vec![Nearest::NONE; b.len()];
    // A key's index counts vectors of columns.
    let block_columns = L::LANES << INDEX_BITS;
    let mut row_keys = vec![0u32; BLOCK * pair];
    for first_column in (0..b.len()).step_by(block_columns) {
        let last_column = (first_column + block_columns).min(start.len());
        for first_row in (0..a.len()).step_by(BLOCK) {
            let last_row = (first_row + BLOCK).min(a.len());
            let block = &rows[first_row * steps..last_row.next_multiple_of(TILE) * steps];
            row_keys.fill(0);
            for column in (first_column..last_column).step_by(pair) {
                let columns = &columns[column * steps..(column + pair) * steps];
                let start = [0, L::LANES].map(|i| lanes.load(&start[column + i..]));
                let number = ((column - first_column) / L::LANES) as u32;
                let keys = tile_rows(lanes, block, columns, start, number, &mut row_keys);
                for half in 0..2 {
                    let at = column + half * L::LANES;
                    merge_lanes(lanes, keys[half], |lane, [best, second]| {
                        if let Some(of_b) = of_b.get_mut(at + lane) {
                            of_b.merge(
                                first_row as u32 + index_of(best),
                                best >> INDEX_BITS,
                                second >> INDEX_BITS,
                            );
                        }
                    });
                }
            }
            for (of_a, keys) in of_a[first_row..last_row].iter_mut().zip(row_keys.chunks_exact(pair)) {
                for lane in 0..L::LANES {
                    let [best, second] = [keys[lane], keys[L::LANES + lane]];
                    let column = first_column + index_of(best) as usize * L::LANES + lane;
                    of_a.merge(column as u32, best >> INDEX_BITS, second >> INDEX_BITS);
                }
            }
        }
    }
    [of_a, of_b]
}

/// The index in `key`, which is stored inverted so that the largest key has the lowest index.
fn index_of(key: u32) -> u32 {
    INDEX_MASK - (key & INDEX_MASK)
}

#[inline(always)]
fn merge_lanes<L: Lanes>(lanes: L, keys: [L::V; 2], mut merge: impl FnMut(usize, [u32; 2])) {
    let mut values = [[0u32; 16]; 2];
    lanes.store(keys[0], &mut values[0]);
    lanes.store(keys[1], &mut values[1]);
    for lane in 0..L::LANES {
        merge(lane, [values[0][lane], values[1][lane]]);
    }
}

/// The products of the block `rows` with two vectors of `columns`: updates the keys of the rows and returns, for both vectors, the
/// best and second keys of the columns. `start` holds the initial values of the sums.
#[inline(always)]
fn tile_rows<L: Lanes>(
    lanes: L,
    rows: &[u32],
    columns: &[u32],
    start: [L::V; 2],
    number: u32,
    row_keys: &mut [u32],
) -> [[L::V; 2]; 2] {
    let zero = lanes.set(0);
    let mut column_keys = [[zero; 2]; 2];
    let tiles = rows.chunks_exact(TILE * BYTES / L::STEP);
    for ((tile, keys), first_row) in tiles
        .zip(row_keys.chunks_exact_mut(TILE * 2 * L::LANES))
        .zip((0u32..).step_by(TILE))
    {
        let mut sums = [start; TILE];
        for (row, column) in tile
            .as_chunks::<TILE>()
            .0
            .iter()
            .zip(columns.chunks_exact(2 * L::LANES))
        {
            let column = [lanes.load(column), lanes.load(&column[L::LANES..])];
            for i in 0..TILE {
                sums[i][0] = lanes.add_products(sums[i][0], column[0], row[i]);
                sums[i][1] = lanes.add_products(sums[i][1], column[1], row[i]);
            }
        }
        for (i, keys) in keys.chunks_exact_mut(2 * L::LANES).enumerate() {
            let row = INDEX_MASK - (first_row + i as u32);
            for half in 0..2 {
                let key = lanes.key(sums[i][half], row);
                let [best, second] = column_keys[half];
                column_keys[half] = [lanes.max(best, key), lanes.max(second, lanes.min(best, key))];
            }
            let new = [
                lanes.key(sums[i][0], INDEX_MASK - number),
                lanes.key(sums[i][1], INDEX_MASK - number - 1),
            ];
            let (high, low) = (lanes.max(new[0], new[1]), lanes.min(new[0], new[1]));
            let (best, second) = (lanes.load(keys), lanes.load(&keys[L::LANES..]));
            let (new_best, beaten) = (lanes.max(best, high), lanes.min(best, high));
            lanes.store(new_best, keys);
            lanes.store(lanes.max(beaten, lanes.max(second, low)), &mut keys[L::LANES..]);
        }
    }
    column_keys
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pseudo-random vectors; a small `range` causes ties.
    fn vectors(n: usize, seed: u32, range: u32) -> Vec<[u8; BYTES]> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            ((state >> 8) % range) as u8
        };
        (0..n).map(|_| std::array::from_fn(|_| next())).collect()
    }

    fn by_definition(a: &[[u8; BYTES]], b: &[[u8; BYTES]]) -> Vec<Nearest> {
        let product =
            |a: &[u8; BYTES], b: &[u8; BYTES]| a.iter().zip(b).map(|(a, b)| u32::from(*a) * u32::from(*b)).sum();
        a.iter()
            .map(|a| {
                let mut nearest = Nearest::NONE;
                for (i, b) in b.iter().enumerate() {
                    nearest.merge(i as u32, product(a, b), 0);
                }
                nearest
            })
            .collect()
    }

    #[test]
    fn every_level_finds_the_nearest_by_definition() {
        for (n, m, range) in [
            (1, 1, 256),
            (3, 40, 2),
            (300, 77, 256),
            (513, 130, 3),
            (9, 2100, 256),
            (0, 5, 256),
        ] {
            let (a, b) = (vectors(n, 1, range), vectors(m, 2, range));
            let expected = match n {
                0 => [Vec::new(), Vec::new()],
                _ => [by_definition(&a, &b), by_definition(&b, &a)],
            };
            for level in Level::all() {
                assert_eq!(nearest(level, &a, &b), expected, "{} {n} {m}", level.name());
            }
            if n > 0 {
                assert_eq!(search(Arrays, &a, &b), expected, "arrays {n} {m}");
            }
        }
    }

    #[test]
    fn the_largest_and_smallest_bytes_do_not_overflow() {
        let a = vec![[255; BYTES], [0; BYTES]];
        for level in Level::all() {
            let [of_a, of_b] = nearest(level, &a, &a);
            assert_eq!(of_a, of_b);
            let expected = Nearest {
                index: 0,
                product: 128 * 255 * 255,
                second: 0,
            };
            assert_eq!(of_a[0], expected, "{}", level.name());
            assert_eq!((of_a[1].index, of_a[1].product), (0, 0), "{}", level.name());
        }
    }
}
