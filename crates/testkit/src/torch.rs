//! Writes PyTorch files as `torch.save` would for a state dict: pickle protocol 2, opcode by opcode.

/// Name, shape and values.
pub type NamedTensor<'a> = (&'a str, &'a [usize], &'a [f32]);

fn text(value: &str) -> Vec<u8> {
    [b"X", &(value.len() as u32).to_le_bytes()[..], value.as_bytes()].concat()
}

fn integer(value: usize) -> Vec<u8> {
    match u8::try_from(value) {
        Ok(value) => vec![b'K', value],
        Err(_) => [b"J", &(value as u32).to_le_bytes()[..]].concat(),
    }
}

fn tuple(values: impl IntoIterator<Item = usize>) -> Vec<u8> {
    let items: Vec<u8> = values.into_iter().flat_map(integer).collect();
    [b"(", &items[..], b"t"].concat()
}

/// `module.name(arguments)`.
fn call(module: &str, name: &str, arguments: &[u8]) -> Vec<u8> {
    [format!("c{module}\n{name}\n").as_bytes(), b"(", arguments, b"tR"].concat()
}

/// A tensor in storage `key`; its shape is memoised, as in real pickles.
fn tensor(key: usize, shape: &[usize], count: usize) -> Vec<u8> {
    let strides: Vec<usize> = (0..shape.len()).map(|i| shape[i + 1..].iter().product()).collect();
    let storage = [
        &b"("[..],
        &text("storage"),
        b"ctorch\nFloatStorage\n",
        &text(&key.to_string()),
        &text("cpu"),
        &integer(count),
        b"tQ",
    ]
    .concat();
    let arguments = [
        &storage[..],
        &integer(0),
        &tuple(shape.iter().copied()),
        b"q\x05",
        &tuple(strides),
        b"\x89",
        &call("collections", "OrderedDict", b""),
    ]
    .concat();
    call("torch._utils", "_rebuild_tensor_v2", &arguments)
}

/// The pickle of the state dict, with the `_metadata` attribute that torch adds.
fn state_dict(tensors: &[NamedTensor]) -> Vec<u8> {
    let mut out = b"\x80\x02".to_vec();
    out.extend(call("collections", "OrderedDict", b""));
    out.extend(b"q\x00(");
    for (key, (name, shape, values)) in tensors.iter().enumerate() {
        out.extend(text(name));
        out.extend(tensor(key, shape, values.len()));
    }
    out.extend(b"u}");
    out.extend(text("_metadata"));
    out.extend(call("collections", "OrderedDict", b""));
    out.extend(b"sb.");
    out
}

fn bytes(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// The format since PyTorch 1.6: a zip archive.
pub fn archive(tensors: &[NamedTensor]) -> Vec<u8> {
    let mut files = vec![("net/data.pkl".to_owned(), state_dict(tensors))];
    files.push(("net/byteorder".to_owned(), b"little".to_vec()));
    for (key, (_, _, values)) in tensors.iter().enumerate() {
        files.push((format!("net/data/{key}"), bytes(values)));
    }
    zip(&files)
}

/// A zip archive of uncompressed files, with padding as PyTorch adds for alignment.
pub fn zip(files: &[(String, Vec<u8>)]) -> Vec<u8> {
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for (name, content) in files {
        let at = out.len() as u32;
        let size = (content.len() as u32).to_le_bytes();
        // Version, flags, method, time and checksum, which readers ignore; sizes; length of the name.
        let common = [
            &[20, 0, 0, 0, 0, 0][..],
            &[0; 8],
            &size,
            &size,
            &(name.len() as u16).to_le_bytes(),
        ]
        .concat();
        out.extend(
            [
                &b"PK\x03\x04"[..],
                &common,
                &[5, 0],
                name.as_bytes(),
                b"FB\x01\x00Z",
                content,
            ]
            .concat(),
        );
        directory.extend(
            [
                &b"PK\x01\x02\x14\x00"[..],
                &common,
                &[0; 12],
                &at.to_le_bytes(),
                name.as_bytes(),
            ]
            .concat(),
        );
    }
    let (start, count) = (out.len() as u32, (files.len() as u16).to_le_bytes());
    let size = directory.len() as u32;
    out.extend(directory);
    out.extend(
        [
            &b"PK\x05\x06\0\0\0\0"[..],
            &count,
            &count,
            &size.to_le_bytes(),
            &start.to_le_bytes(),
            &[0, 0],
        ]
        .concat(),
    );
    out
}

/// The format before PyTorch 1.6: a stream of pickles, then the storages.
pub fn stream(tensors: &[NamedTensor]) -> Vec<u8> {
    let mut out = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.".to_vec();
    out.extend(b"\x80\x02M\xe9\x03.");
    out.extend([b"\x80\x02}(", &text("little_endian")[..], b"\x88u."].concat());
    out.extend(state_dict(tensors));
    out.extend(b"\x80\x02](");
    (0..tensors.len()).for_each(|key| out.extend(text(&key.to_string())));
    out.extend(b"e.");
    for (_, _, values) in tensors {
        out.extend((values.len() as u64).to_le_bytes());
        out.extend(bytes(values));
    }
    out
}
