// Moves keys and values to their places by one digit of eight bits, keeping the order of equal ones. A block of 2,048 is sorted in shared
// memory first, by four bits at a time, so that keys with the same digit are written side by side.
struct Params { count: u32, blocks: u32, shift: u32 }
@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
// [block, digit]: number of keys with this digit in the blocks before; in the row after the last block, in all blocks.
@group(0) @binding(3) var<storage, read> counts: array<u32>;
@group(0) @binding(4) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> sorted_values: array<u32>;

const SCANNED: u32 = 128u;
// Digit and, from bit 8 on, place in the block; a word of padding follows every 16, so that threads that visit 16 in a row each cause no
// bank conflicts.
var<workgroup> held: array<u32, 2176>;
// How often each thread has each of 16 digits; digits d and d + 8 share a word.
var<workgroup> counters: array<u32, 1024>;
var<workgroup> shared_sums: array<u32, SCANNED>;
// For each digit, the place of its first key in the sorted block, and in the output.
var<workgroup> firsts: array<u32, 256>;
var<workgroup> starts: array<u32, 256>;

@compute @workgroup_size(128)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let block = group_index(group, groups);
    let first = block * 2048u;
    for (var i = 0u; i < 16u; i++) {
        let place = i * 128u + at;
        // Places after the last key stay after it.
        var digit = 255u;
        if first + place < params.count {
            digit = (keys[first + place] >> params.shift) & 255u;
        }
        held[padded(place)] = digit | (place << 8u);
    }
    split(0u, at);
    split(4u, at);

    let digit = 2u * at;
    let here = block * 256u + digit;
    let behind = params.blocks * 256u + digit;
    let totals = vec2u(counts[behind], counts[behind + 1u]);
    let before = inclusive_scan(totals.x + totals.y, at) - totals.x - totals.y;
    starts[digit] = before + counts[here];
    starts[digit + 1u] = before + totals.x + counts[here + 1u];
    for (var i = 0u; i < 16u; i++) {
        let place = i * 128u + at;
        let own = held[padded(place)] & 255u;
        if place == 0u || (held[padded(max(place, 1u) - 1u)] & 255u) != own {
            firsts[own] = place;
        }
    }
    workgroupBarrier();
    for (var i = 0u; i < 16u; i++) {
        let place = i * 128u + at;
        let own = held[padded(place)];
        let source = first + (own >> 8u);
        if source < params.count {
            let to = starts[own & 255u] + place - firsts[own & 255u];
            sorted_keys[to] = keys[source];
            sorted_values[to] = values[source];
        }
    }
}

fn padded(place: u32) -> u32 {
    return place + (place >> 4u);
}

// Sorts `held` by the four bits from `shift` on.
fn split(shift: u32, at: u32) {
    for (var row = 0u; row < 8u; row++) {
        counters[row * 128u + at] = 0u;
    }
    workgroupBarrier();
    var own: array<u32, 16>;
    for (var i = 0u; i < 16u; i++) {
        own[i] = held[17u * at + i];
        let digit = (own[i] >> shift) & 15u;
        counters[(digit & 7u) * 128u + at] += 1u << (2u * (digit & 8u));
    }
    workgroupBarrier();
    // Replaces counters by the sums of those before them, row by row; both halves of the words at once.
    var counted: array<u32, 8>;
    var sum = 0u;
    for (var i = 0u; i < 8u; i++) {
        counted[i] = counters[at * 8u + i];
        sum += counted[i];
    }
    var total = inclusive_scan(sum, at) - sum;
    // All digits of the lower half come before those of the upper half.
    total += (workgroupUniformLoad(&shared_sums[SCANNED - 1u]) & 0xffffu) << 16u;
    for (var i = 0u; i < 8u; i++) {
        counters[at * 8u + i] = total;
        total += counted[i];
    }
    workgroupBarrier();
    for (var i = 0u; i < 16u; i++) {
        let digit = (own[i] >> shift) & 15u;
        let half = 2u * (digit & 8u);
        let counter = (digit & 7u) * 128u + at;
        let rank = (counters[counter] >> half) & 0xffffu;
        counters[counter] += 1u << half;
        held[padded(rank)] = own[i];
    }
    workgroupBarrier();
}
