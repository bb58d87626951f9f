//! Detection of truncated image files. The JPEG decoder silently fills missing data with grey, and a truncated PNG would fail
//! only when it is decoded, in the middle of training.

use std::io::{self, BufRead, Seek};

/// Length of the end of a file, bytes, in which its last marker is usually found.
const TAIL_BYTES: u64 = 4096;

/// Whether a JPEG in memory has its end-of-image marker after the start of its scan.
///
/// The search starts after the headers, which may contain a thumbnail, itself a JPEG with both markers.
pub(crate) fn jpeg_is_complete(bytes: &[u8]) -> bool {
    let mut rest = bytes.get(2..).unwrap_or_default();
    loop {
        match rest {
            // Any number of fill bytes may precede a marker.
            [0xFF, 0xFF, ..] => rest = &rest[1..],
            [0xFF, 0xDA, scan @ ..] => return scan.windows(2).rev().any(|pair| pair == [0xFF, 0xD9]),
            [0xFF, _, high, low, ..] => {
                let length = usize::from(u16::from_be_bytes([*high, *low]));
                rest = rest.get(2 + length..).unwrap_or_default();
            }
            _ => return false,
        }
    }
}

/// [`jpeg_is_complete`] for a file: reads its headers and its end, and the whole file only if the end has no marker.
pub(crate) fn jpeg_file_is_complete(reader: &mut (impl BufRead + Seek)) -> io::Result<bool> {
    let length = reader.seek(io::SeekFrom::End(0))?;
    let mut offset = 2;
    loop {
        if offset + 4 > length {
            return Ok(false);
        }
        reader.seek(io::SeekFrom::Start(offset))?;
        let mut header = [0u8; 4];
        reader.read_exact(&mut header)?;
        match header {
            [0xFF, 0xFF, ..] => offset += 1,
            [0xFF, 0xDA, ..] => break,
            [0xFF, _, high, low] => offset += 2 + u64::from(u16::from_be_bytes([high, low])),
            _ => return Ok(false),
        }
    }
    for tail in [TAIL_BYTES, length] {
        reader.seek(io::SeekFrom::Start((offset + 2).max(length.saturating_sub(tail))))?;
        let mut bytes = Vec::new();
        reader.read_to_end(&mut bytes)?;
        if bytes.windows(2).rev().any(|pair| pair == [0xFF, 0xD9]) {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Whether a PNG's chunks lead to its `IEND`. The reader's position afterwards is arbitrary.
pub(crate) fn png_is_complete(reader: &mut (impl BufRead + Seek)) -> io::Result<bool> {
    let length = reader.seek(io::SeekFrom::End(0))?;
    let mut offset = 8;
    while offset + 12 <= length {
        reader.seek(io::SeekFrom::Start(offset))?;
        let mut header = [0u8; 8];
        reader.read_exact(&mut header)?;
        if header[4..] == *b"IEND" {
            return Ok(true);
        }
        offset += 12 + u64::from(u32::from_be_bytes([header[0], header[1], header[2], header[3]]));
    }
    Ok(false)
}
