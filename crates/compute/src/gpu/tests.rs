use super::*;

/// The device on which tests run: software if there is no other. Without any, tests are skipped with a message.
fn gpu() -> Option<Arc<Gpu>> {
    irradia_testkit::gpu_or_skip(|| Gpu::open(&Wanted::Any))
}

#[test]
fn an_adapter_that_cannot_be_used_is_not_opened_by_its_name() {
    let adapter = |name: &str, kind: AdapterKind, is_usable: bool| {
        let info = AdapterInfo {
            name: name.to_owned(),
            kind,
            api: "Vulkan".to_owned(),
            driver: String::new(),
            largest_array: 1 << 30,
            shared_memory: 32 << 10,
            subgroup: [32; 2],
            is_usable,
        };
        ((), info)
    };
    let old = || adapter("Old Card", AdapterKind::Discrete, false);
    let new = || adapter("New Card", AdapterKind::Integrated, true);
    let software = || adapter("llvmpipe", AdapterKind::Software, true);
    let named = |name: &str| Wanted::Named(name.to_owned());
    let name = |list: Vec<((), AdapterInfo)>, wanted: &Wanted| chosen(list, wanted).map(|(_, info)| info.name);
    let refused = name(vec![old(), new()], &named("old")).unwrap_err().to_string();
    assert!(refused.starts_with("the GPU Old Card cannot be used: "), "{refused}");
    assert_eq!(name(vec![old(), new()], &named("card")).unwrap(), "New Card");
    assert_eq!(name(vec![old(), new(), software()], &Wanted::Any).unwrap(), "New Card");
    assert_eq!(name(vec![old(), software()], &Wanted::Any).unwrap(), "llvmpipe");
    let none = name(vec![old(), software()], &Wanted::Real).unwrap_err().to_string();
    assert!(none.starts_with("no GPU was found"), "{none}");
    let none = name(vec![new()], &named("old")).unwrap_err().to_string();
    assert!(none.starts_with("no GPU is called"), "{none}");
}

#[test]
fn every_shader_is_valid() {
    use crate::shaders::{SCAN, SORT, SORT_SIZES};
    for shader in SCAN.iter().chain(&SORT).chain([&SORT_SIZES]) {
        irradia_testkit::validate_shader(shader.name, &shader.source());
    }
}

#[test]
fn prefix_sums_of_few_and_many_words_are_those_of_a_loop() {
    let Some(gpu) = gpu() else { return };
    let (mut scan, params) = (Scan::new(&gpu), Scan::params(&gpu));
    gpu.check().unwrap();
    for count in [1, 255, 2048, 2049, 300_000, 600_001] {
        let values: Vec<u32> = (0..count as u32).map(|i| i.wrapping_mul(2_654_435_761) >> 24).collect();
        let from = Array::of(&gpu, "values", &values);
        let to = Array::zeros(&gpu, "before", count);
        let mut work = Work::new(&gpu);
        scan.run(&mut work, &params, &from, &to, count);
        work.submit();
        let mut sum = 0;
        for (i, (value, before)) in values.iter().zip(to.to_vec::<u32>(&gpu, count)).enumerate() {
            assert_eq!(before, sum, "{i} of {count}");
            sum += value;
        }
    }
    gpu.check().unwrap();
}

#[test]
fn a_kernel_serves_more_arrays_than_it_remembers_and_those_that_have_moved() {
    let Some(gpu) = gpu() else { return };
    let (mut scan, params) = (Scan::new(&gpu), Scan::params(&gpu));
    let array = || Array::zeros(&gpu, "few words", 4);
    let mut pairs: Vec<[Array; 2]> = (0..20).map(|_| [array(), array()]).collect();
    for round in 0..3u32 {
        for (i, [from, to]) in (0u32..).zip(&mut pairs) {
            if round == 2 {
                // This moves them to other memory.
                from.reserve(&gpu, 1000);
                to.reserve(&gpu, 1000);
            }
            from.write(&gpu, 0, &[100 * round + i, 1, 1]);
            let mut work = Work::new(&gpu);
            scan.run(&mut work, &params, from, to, 3);
            work.submit();
        }
        for (i, [_, to]) in (0u32..).zip(&pairs) {
            let first = 100 * round + i;
            assert_eq!(to.to_vec::<u32>(&gpu, 3), [0, first, first + 1], "{i} in round {round}");
        }
    }
    gpu.check().unwrap();
}

#[test]
fn sorting_keeps_the_order_of_equal_keys() {
    let Some(gpu) = gpu() else { return };
    let mut sort = Sort::new(&gpu, 32);
    gpu.check().unwrap();
    for (count, bits) in [(1, 32), (17, 8), (4096, 32), (100_003, 32), (100_003, 13)] {
        let mask = u32::MAX >> (32 - bits);
        let keys: Vec<u32> = (0..count as u32)
            .map(|i| (i ^ 0x5a5a).wrapping_mul(2_654_435_761) & mask & !(i & 6))
            .collect();
        let key_array = Array::of(&gpu, "keys", &keys);
        let value_array = Array::of(&gpu, "values", &(0..count as u32).collect::<Vec<_>>());
        let mut work = Work::new(&gpu);
        // Room for more keys than there are, as in cases where only the device knows the number.
        let known = Array::of(&gpu, "count", &[count as u32]);
        sort.run(&mut work, &key_array, &value_array, &known, count + count / 3, bits);
        work.submit();
        let mut expected: Vec<u32> = (0..count as u32).collect();
        expected.sort_by_key(|i| keys[*i as usize]);
        let got = value_array.to_vec::<u32>(&gpu, count);
        assert!(got == expected, "{count} keys of {bits} bits");
        let sorted = key_array.to_vec::<u32>(&gpu, count);
        assert!(sorted.iter().zip(&got).all(|(key, i)| *key == keys[*i as usize]));
    }
    gpu.check().unwrap();
}

#[test]
fn words_are_read_in_pieces_in_parts_and_late() {
    let Some(gpu) = gpu() else { return };
    let words: Vec<u32> = (0..9_000_000).collect();
    let array = Array::of(&gpu, "words", &words);
    assert!(array.to_vec::<u32>(&gpu, words.len()) == words);
    let part = array.part(8_388_600, 20);
    assert_eq!(part.to_vec::<u32>(&gpu, 20), (8_388_600..8_388_620).collect::<Vec<_>>());
    let (mut readback, mut got) = (Readback::new(&gpu, 2), [9u32; 2]);
    readback.take(&gpu, &mut got);
    assert_eq!(got, [0, 0], "nothing was sent");
    for first in [3, 5] {
        Work::new(&gpu).submit_reading(&array.part(first, 2), &mut readback);
    }
    array.write(&gpu, 5, &[7u32]);
    Work::new(&gpu).submit();
    readback.take(&gpu, &mut got);
    assert_eq!(got, [5, 6], "the last that were sent, as they were then");
    gpu.check().unwrap();
}

#[test]
fn a_shader_that_does_not_compile_is_a_failure_and_not_a_panic() {
    let Some(gpu) = gpu() else { return };
    let shader = Shader {
        name: "broken",
        parts: &["fn main( {"],
    };
    Kernel::new(&gpu, &shader);
    let error = gpu.check().unwrap_err().to_string();
    assert!(error.contains("failed") && !error.contains('\n'), "{error}");
}
