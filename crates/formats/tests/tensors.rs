//! State dicts of PyTorch and safetensors files: the same tensors from each, and hostile ones rejected in one line.

use irradia_formats::{parse, read_tensors};
use irradia_testkit::torch::{NamedTensor, archive, stream, zip};
use safetensors::Dtype;
use safetensors::tensor::TensorView;

const TENSORS: [NamedTensor; 3] = [
    ("features.0.weight", &[2, 1, 3], &[1.0, 2.0, 3.0, -4.0, 5.5, 1e-9]),
    ("features.0.bias", &[2], &[0.25, -0.5]),
    ("one", &[], &[7.0]),
];

fn safetensors_file() -> Vec<u8> {
    let bytes: Vec<Vec<u8>> = TENSORS
        .iter()
        .map(|(_, _, values)| values.iter().flat_map(|v| v.to_le_bytes()).collect())
        .collect();
    let view = |shape: &[usize], bytes| TensorView::new(Dtype::F32, shape.to_vec(), bytes).unwrap();
    let views = TENSORS
        .iter()
        .zip(&bytes)
        .map(|((name, shape, _), bytes)| (*name, view(shape, bytes)));
    safetensors::serialize(views, None).unwrap()
}

#[test]
fn every_format_gives_the_same_tensors() {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in [
        ("a.pth", archive(&TENSORS)),
        ("b.pth", stream(&TENSORS)),
        ("c.safetensors", safetensors_file()),
    ] {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        let all = read_tensors(&path, |_| true).unwrap();
        assert_eq!(all.len(), 3, "{name}");
        for (tensor, shape, values) in TENSORS {
            assert_eq!(
                (&all[tensor].shape[..], &all[tensor].values[..]),
                (shape, values),
                "{name}"
            );
        }
        let biases = read_tensors(&path, |tensor| tensor.ends_with("bias")).unwrap();
        assert_eq!(biases.keys().collect::<Vec<_>>(), ["features.0.bias"]);
    }
    let missing = read_tensors(&folder.path().join("absent"), |_| true)
        .unwrap_err()
        .to_string();
    assert!(missing.starts_with("cannot read"), "{missing}");
}

/// The archive with `pickle` in place of its own.
fn with_pickle(pickle: &[u8]) -> Vec<u8> {
    zip(&[
        ("net/data.pkl".to_owned(), pickle.to_vec()),
        ("net/data/0".to_owned(), vec![0; 64]),
    ])
}

/// A state dict of one tensor whose storage, offset, shape and strides are made by these opcodes.
fn with_tensor(kind: &str, offset: &str, shape: &str, strides: &str) -> Vec<u8> {
    let pickle = format!(
        "\u{2}ccollections\nOrderedDict\n)R(U\u{1}actorch._utils\n_rebuild_tensor_v2\n((U\u{7}storagectorch\n{kind}Storage\n\
         U\u{1}0U\u{3}cpuK\u{10}tQ{offset}({shape}t({strides}tNNtRu."
    );
    with_pickle(&[b"\x80", pickle.as_bytes()].concat())
}

#[test]
fn hostile_files_are_rejected_in_one_line() {
    let assert_refused = |bytes: &[u8], expected: &str| {
        let error = parse::tensors(bytes).expect_err(expected).to_string();
        assert!(
            error.contains(expected) && !error.contains('\n'),
            "{error}, and not {expected}"
        );
    };
    assert_eq!(
        parse::tensors(&with_tensor("Float", "K\u{2}", "K\u{2}K\u{7}", "K\u{7}K\u{1}")).unwrap()["a"].values,
        [0.0; 14]
    );
    // Wrong sizes, in the tensor and in the storage.
    assert_refused(
        &with_tensor("Float", "K\u{3}", "K\u{2}K\u{7}", "K\u{7}K\u{1}"),
        "larger than its storage",
    );
    assert_refused(
        &with_tensor("Float", "J\u{7f}\u{7f}\u{7f}\u{7f}", "K\u{1}", "K\u{1}"),
        "larger than its storage",
    );
    let huge = "J\u{7f}\u{7f}\u{7f}\u{7f}".repeat(3);
    assert_refused(
        &with_tensor("Float", "K\u{0}", &huge, "K\u{1}K\u{1}K\u{1}"),
        "not contiguous",
    );
    assert_refused(
        &with_tensor("Float", "K\u{0}", &"K\u{1}".repeat(40), &"K\u{1}".repeat(40)),
        "unsupported kind",
    );
    assert_refused(
        &with_tensor("Float", "K\u{0}", "K\u{2}K\u{7}", "K\u{1}K\u{2}"),
        "not contiguous",
    );
    assert_refused(
        &with_tensor("Double", "K\u{0}", "K\u{1}", "K\u{1}"),
        "only 32-bit floats",
    );
    // A call that would run a program in Python is only a call that makes no tensor.
    assert_refused(&with_pickle(b"\x80\x02cos\nsystem\n(U\x02lstR."), "state_dict()");
    // Pickles that never end, pop from an empty stack, nest, or call themselves.
    assert_refused(&with_pickle(b"\x80\x02}"), "ends too early");
    assert_refused(&with_pickle(b"\x80\x02X\xff\xff\xff\xff"), "ends too early");
    assert_refused(&with_pickle(b"\x80\x02u"), "no mark");
    assert_refused(&with_pickle(b"\x80\x02\x87"), "empty stack");
    assert_refused(&with_pickle(b"\x80\x02h\x07"), "recalls");
    assert_refused(&with_pickle(b"\x80\x04."), "protocol 4");
    assert_refused(&with_pickle(b"\x80\x02\x93"), "opcode 0x93");
    assert_refused(&with_pickle(&b"(".repeat(3 << 20)), "too many");
    assert_refused(&with_pickle(&b"]".repeat(3 << 20)), "too many");
    let circle = with_pickle(b"\x80\x02}q\x00(U\x01ah\x00u.");
    assert_refused(&circle, "unsupported kind");
    // A list of 50,000 pairs that is converted to a dict 50,000 times.
    let mut bomb = b"\x80\x02ccollections\nOrderedDict\nq\x00](".to_vec();
    bomb.extend(b"NN\x86".repeat(50_000));
    bomb.extend(b"e\x85q\x01");
    bomb.extend(b"h\x00h\x01R".repeat(50_000));
    assert_refused(&with_pickle(&bomb), "too many");
    // The same storage a thousand times is larger than the file.
    let name = |i: usize| format!("t{i}");
    let names: Vec<String> = (0..1000).map(name).collect();
    let many: Vec<NamedTensor> = names.iter().map(|n| (&n[..], &[4usize][..], &[0.0; 4][..])).collect();
    assert_eq!(parse::tensors(&archive(&many)).unwrap().len(), 1000);
    let mut stretched = b"\x80\x02}(".to_vec();
    for i in 0..1000 {
        stretched.extend(format!("U\u{4}{i:04}").bytes());
        stretched.extend(if i == 0 { &b"ctorch._utils\n_rebuild_tensor\n((U\x07storagectorch\nFloatStorage\nU\x010U\x03cpuK\x10tQK\x00(M\x00\x40t(K\x01ttRq\x01"[..] } else { b"h\x01" });
    }
    stretched.extend(b"u.");
    let files = [
        ("n/data.pkl".to_owned(), stretched),
        ("n/data/0".to_owned(), vec![0; 1 << 16]),
    ];
    assert_refused(&zip(&files), "larger than the file");
    // Archives.
    let whole = archive(&TENSORS);
    assert_refused(&whole[..whole.len() - 5], "its end is missing");
    let mut packed = whole.clone();
    let directory = whole.windows(4).position(|w| w == b"PK\x01\x02").unwrap();
    packed[directory + 10] = 8;
    assert_refused(&packed, "compressed");
    let mut elsewhere = whole.clone();
    elsewhere[directory + 42] = 9;
    assert_refused(&elsewhere, "not where the directory says");
    assert_refused(&zip(&[("readme".to_owned(), vec![1])]), "no data.pkl");
    let legacy = stream(&TENSORS);
    assert_refused(&legacy[..legacy.len() - 3], "declares");
    assert_refused(b"\x80\x02}.", "does not begin");
    assert_refused(b"", "neither");
}
