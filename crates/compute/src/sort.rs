//! A stable radix sort of 32-bit keys with 32-bit payloads.

use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Key in the upper half, payload in the lower. Atomic so that threads can scatter into one array without `unsafe`;
/// a relaxed store compiles to an ordinary store.
pub type Pair = AtomicU64;

/// Packs a key and a payload.
#[inline(always)]
pub fn pair(key: u32, payload: u32) -> Pair {
    Pair::new(u64::from(key) << 32 | u64::from(payload))
}

/// The payload of a pair.
#[inline(always)]
pub fn payload(pair: &Pair) -> u32 {
    pair.load(Relaxed) as u32
}

const DIGIT_BITS: u32 = 11;
const BUCKETS: usize = 1 << DIGIT_BITS;
/// Below this length one thread is faster than several.
const MIN_PARALLEL_LEN: usize = 1 << 15;

/// Sorts `items` by key, stably; `scratch` is resized to match and reused.
///
/// Because the sort is stable, the result depends neither on the number of threads nor on how the work is split.
pub fn sort_by_key(items: &mut Vec<Pair>, scratch: &mut Vec<Pair>) {
    let n = items.len();
    scratch.resize_with(n, Pair::default);
    let parts = if n < MIN_PARALLEL_LEN {
        1
    } else {
        rayon::current_num_threads()
    };
    let part = n.div_ceil(parts).max(1);
    for pass in 0..3 {
        let shift = 32 + pass * DIGIT_BITS;
        let digit = |item: u64| (item >> shift) as usize & (BUCKETS - 1);
        let mut counts: Vec<Vec<u32>> = items
            .par_chunks(part)
            .map(|chunk| {
                let mut count = vec![0u32; BUCKETS];
                for item in chunk {
                    count[digit(item.load(Relaxed))] += 1;
                }
                count
            })
            .collect();
        if (0..BUCKETS).any(|b| counts.iter().map(|c| c[b] as usize).sum::<usize>() == n) {
            continue; // All keys share this digit.
        }
        let mut at = 0;
        for bucket in 0..BUCKETS {
            for count in &mut counts {
                at += std::mem::replace(&mut count[bucket], at);
            }
        }
        items.par_chunks(part).zip(&mut counts).for_each(|(chunk, at)| {
            for item in chunk {
                let item = item.load(Relaxed);
                let slot = &mut at[digit(item)];
                scratch[*slot as usize].store(item, Relaxed);
                *slot += 1;
            }
        });
        std::mem::swap(items, scratch);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sorted(keys: &[u32]) -> Vec<(u32, u32)> {
        let mut items: Vec<Pair> = keys.iter().enumerate().map(|(i, k)| pair(*k, i as u32)).collect();
        sort_by_key(&mut items, &mut Vec::new());
        items
            .iter()
            .map(|p| p.load(Relaxed))
            .map(|p| ((p >> 32) as u32, p as u32))
            .collect()
    }

    #[test]
    fn matches_the_standard_stable_sort() {
        for n in [0usize, 1, 2, 1000, 3 * MIN_PARALLEL_LEN + 17] {
            let mut state = 12345u32;
            let keys: Vec<u32> = (0..n)
                .map(|_| {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    // Few distinct keys in one run, to test stability.
                    if n == 1000 { state >> 28 } else { state }
                })
                .collect();
            let mut expected: Vec<(u32, u32)> = keys.iter().enumerate().map(|(i, k)| (*k, i as u32)).collect();
            expected.sort_by_key(|(k, _)| *k);
            assert_eq!(sorted(&keys), expected);
        }
    }
}
