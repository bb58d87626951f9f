//! NumPy's array files, as far as datasets need them: two dimensions of floats.
//! <https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html>

use crate::Malformed;
use irradia_scene::half::from_half;

/// A `[rows, columns]` array, row-major.
pub(crate) struct Table {
    pub rows: usize,
    pub columns: usize,
    pub values: Vec<f64>,
}

/// Parses an `.npy` file of version 1 to 3 with two dimensions of 2-, 4- or 8-byte floats, and any number of dimensions of length 1.
pub(crate) fn parse_table(bytes: &[u8]) -> Result<Table, Malformed> {
    let malformed = |reason: &str| Malformed(format!("not a usable .npy file: {reason}"));
    let rest = bytes
        .strip_prefix(b"\x93NUMPY")
        .ok_or_else(|| malformed("it does not start with \\x93NUMPY"))?;
    let (length, rest) = match rest {
        [1, _, a, b, rest @ ..] => (usize::from(u16::from_le_bytes([*a, *b])), rest),
        [2 | 3, _, a, b, c, d, rest @ ..] => (u32::from_le_bytes([*a, *b, *c, *d]) as usize, rest),
        _ => return Err(malformed("its version is unknown or it ends too early")),
    };
    let (header, data) = rest
        .split_at_checked(length)
        .ok_or_else(|| malformed("it ends within its header"))?;
    let header = String::from_utf8_lossy(header);

    let kind = header_value(&header, "descr")
        .map(|v| v.trim_matches(['\'', '"']))
        .unwrap_or_default();
    let (size, big_endian) = match kind {
        "<f8" => (8, false),
        ">f8" => (8, true),
        "<f4" => (4, false),
        ">f4" => (4, true),
        "<f2" => (2, false),
        ">f2" => (2, true),
        _ => return Err(malformed(&format!("its type is {kind}, not f8, f4 or f2"))),
    };
    let shape = header_value(&header, "shape").unwrap_or_default();
    let mut sizes: Option<Vec<usize>> = shape
        .trim_matches(['(', ')'])
        .split(',')
        .map(str::trim)
        .filter(|s| !s.is_empty())
        .map(|s| s.parse().ok())
        .collect();
    if let Some(sizes) = &mut sizes
        && sizes.len() > 2
    {
        // An image of one channel is `(H, W, 1)`, a batch of one `(1, H, W)`.
        sizes.retain(|size| *size != 1);
    }
    let Some([rows, columns]) = sizes.as_deref() else {
        return Err(malformed(&format!("its shape is {shape}, not two numbers")));
    };
    let (rows, columns) = (*rows, *columns);
    let needed = rows.checked_mul(columns).and_then(|count| count.checked_mul(size));
    if needed.is_none_or(|needed| needed > data.len()) {
        return Err(malformed(&format!(
            "its shape {shape} declares more than the {} bytes that follow",
            data.len()
        )));
    }
    let value = |index: usize| {
        let bytes = &data[index * size..(index + 1) * size];
        let mut native = [0u8; 8];
        native[..size].copy_from_slice(bytes);
        if big_endian {
            native[..size].reverse();
        }
        match size {
            8 => f64::from_le_bytes(native),
            2 => f64::from(from_half(u16::from_le_bytes([native[0], native[1]]))),
            _ => f64::from(f32::from_le_bytes([native[0], native[1], native[2], native[3]])),
        }
    };
    let column_major = header_value(&header, "fortran_order") == Some("True");
    let index = |row: usize, column: usize| {
        if column_major {
            column * rows + row
        } else {
            row * columns + column
        }
    };
    let values = (0..rows * columns)
        .map(|i| value(index(i / columns, i % columns)))
        .collect();
    Ok(Table { rows, columns, values })
}

/// The text of a key's value in the header's Python dictionary; brackets are kept together.
fn header_value<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    let start = header.find(&format!("'{key}'"))? + key.len() + 2;
    let text = header[start..].trim_start().strip_prefix(':')?.trim_start();
    let end = if text.starts_with('(') {
        text.find(')')? + 1
    } else {
        text.find([',', '}'])?
    };
    Some(text[..end].trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(version: u8, header: &str, data: &[u8]) -> Vec<u8> {
        let mut bytes = b"\x93NUMPY".to_vec();
        bytes.extend([version, 0]);
        match version {
            1 => bytes.extend((header.len() as u16).to_le_bytes()),
            _ => bytes.extend((header.len() as u32).to_le_bytes()),
        }
        bytes.extend(header.bytes());
        bytes.extend(data);
        bytes
    }

    #[test]
    fn versions_types_and_orders() {
        let doubles: Vec<u8> = [1.0f64, 2.0, 3.0, 4.0, 5.0, 6.0]
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .collect();
        let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3), }  \n";
        let table = parse_table(&file(1, header, &doubles)).unwrap();
        assert_eq!(
            (table.rows, table.columns, &table.values[..]),
            (2, 3, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0][..])
        );
        let fortran = header.replace("False", "True");
        assert_eq!(
            parse_table(&file(2, &fortran, &doubles)).unwrap().values,
            [1.0, 3.0, 5.0, 2.0, 4.0, 6.0]
        );
        let floats: Vec<u8> = [1.5f32, -2.0].iter().flat_map(|v| v.to_be_bytes()).collect();
        let header = "{'descr':'>f4','fortran_order':False,'shape':(1,2)}";
        assert_eq!(parse_table(&file(3, header, &floats)).unwrap().values, [1.5, -2.0]);
    }

    #[test]
    fn dimensions_of_one_and_halves_are_read() {
        let halves: Vec<u8> = [0x3c00u16, 0xc000, 0x3555, 0x7c00]
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .collect();
        for shape in ["(2, 2)", "(2, 2, 1)", "(1, 2, 2)", "(1, 2, 1, 2, 1)"] {
            let header = format!("{{'descr': '<f2', 'fortran_order': False, 'shape': {shape}, }}");
            let table = parse_table(&file(1, &header, &halves)).unwrap();
            assert_eq!(
                (table.rows, table.columns, &table.values[..2]),
                (2, 2, &[1.0, -2.0][..]),
                "{shape}"
            );
            assert!((table.values[2] - 1.0 / 3.0).abs() < 1e-4 && table.values[3] == f64::INFINITY);
        }
        for shape in ["(2, 2, 2)", "(4, 1, 1)"] {
            let header = format!("{{'descr': '<f2', 'fortran_order': False, 'shape': {shape}, }}");
            assert!(parse_table(&file(1, &header, &halves)).is_err(), "{shape}");
        }
    }

    #[test]
    fn declared_sizes_are_checked_against_the_file() {
        for shape in [
            "(9, 17)",
            "(18446744073709551615, 17)",
            "(4294967296, 4294967296)",
            "(3,)",
            "(1, x)",
        ] {
            let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}");
            assert!(parse_table(&file(1, &header, &[0; 64])).is_err(), "{shape}");
        }
        assert!(parse_table(b"\x93NUMPY\x01\x00\xff\xff").is_err());
    }
}
