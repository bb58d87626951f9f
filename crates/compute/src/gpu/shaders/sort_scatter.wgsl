// Moves keys and values to their places by one digit of four bits, keeping the order of equal ones: a thread holds 16 keys in a row,
// and counts its digits in a column of counters; digits d and d + 8 share a word, so that the counters fit in 8 kB.
struct Params { count: u32, blocks: u32, shift: u32 }
@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
@group(0) @binding(3) var<storage, read> starts: array<u32>;
@group(0) @binding(4) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> sorted_values: array<u32>;

var<workgroup> counters: array<u32, 2048>;
var<workgroup> shared_sums: array<u32, 256>;
var<workgroup> first_of_digit: array<u32, 16>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let block = group_index(group, groups);
    let first = block * 4096u + at * 16u;
    for (var row = 0u; row < 8u; row++) {
        counters[row * 256u + at] = 0u;
    }
    var held: array<u32, 16>;
    for (var i = 0u; i < 16u; i++) {
        held[i] = 0u;
        if first + i < params.count {
            held[i] = keys[first + i];
            let digit = (held[i] >> params.shift) & 15u;
            counters[(digit & 7u) * 256u + at] += 1u << (2u * (digit & 8u));
        }
    }
    workgroupBarrier();
    // Counters to the counts before them, row by row; both halves of the words at once.
    var own: array<u32, 8>;
    var sum = 0u;
    for (var i = 0u; i < 8u; i++) {
        own[i] = counters[at * 8u + i];
        sum += own[i];
    }
    var total = inclusive_scan(sum, at) - sum;
    // What has a lower digit comes before all of the upper half.
    total += (workgroupUniformLoad(&shared_sums[255]) & 0xffffu) << 16u;
    for (var i = 0u; i < 8u; i++) {
        counters[at * 8u + i] = total;
        total += own[i];
    }
    workgroupBarrier();
    if at < 16u {
        first_of_digit[at] = (counters[(at & 7u) * 256u] >> (2u * (at & 8u))) & 0xffffu;
    }
    workgroupBarrier();
    for (var i = 0u; i < 16u; i++) {
        if first + i < params.count {
            let digit = (held[i] >> params.shift) & 15u;
            let half = 2u * (digit & 8u);
            let counter = (digit & 7u) * 256u + at;
            let rank = (counters[counter] >> half) & 0xffffu;
            counters[counter] += 1u << half;
            let to = starts[digit * params.blocks + block] + rank - first_of_digit[digit];
            sorted_keys[to] = held[i];
            sorted_values[to] = values[first + i];
        }
    }
}
