//! Decompression with a bound: as many bytes as the caller expects, and never more.

use crate::Malformed;
use flate2::read::{DeflateDecoder, GzDecoder};
use std::io::Read;

/// Maximum window of a zstd frame, bytes; the window is allocated before the first byte is decoded.
const MAX_ZSTD_WINDOW_BYTES: u64 = 128 << 20;

/// A gzip stream, read front to back.
pub(crate) struct Gunzip<'a>(GzDecoder<&'a [u8]>);

impl<'a> Gunzip<'a> {
    pub fn new(packed: &'a [u8]) -> Self {
        Self(GzDecoder::new(packed))
    }

    /// The next `count` bytes; the caller has checked that `count` is plausible.
    pub fn take(&mut self, count: usize) -> Result<Vec<u8>, Malformed> {
        read_exactly(&mut self.0, count, "gzip")
    }

    /// What follows the last value, up to 64 KiB; at the end of the stream, its checksum is compared.
    pub fn finish(self) -> Result<Vec<u8>, Malformed> {
        let mut rest = Vec::new();
        let read = self.0.take(1 << 16).read_to_end(&mut rest);
        read.map(|_| rest).map_err(|error| damaged("gzip", &error))
    }
}

/// A raw deflate stream of `count` bytes, as in a zip archive.
pub(crate) fn inflate(packed: &[u8], count: usize) -> Result<Vec<u8>, Malformed> {
    read_exactly(&mut DeflateDecoder::new(packed), count, "deflate")
}

/// A zstd frame of `count` bytes.
pub(crate) fn unzstd(packed: &[u8], count: usize) -> Result<Vec<u8>, Malformed> {
    let decoder = ruzstd::decoding::StreamingDecoder::new_with_max_window_size(packed, MAX_ZSTD_WINDOW_BYTES);
    let mut decoder = decoder.map_err(|error| damaged("zstd", &error))?;
    read_exactly(&mut decoder, count, "zstd")
}

fn read_exactly(reader: &mut impl Read, count: usize, kind: &str) -> Result<Vec<u8>, Malformed> {
    // Beyond the first 16 MiB, memory grows with what the stream holds, not with what was declared.
    let mut bytes = Vec::with_capacity(count.min(16 << 20));
    let read = reader.take(count as u64).read_to_end(&mut bytes);
    read.map_err(|error| damaged(kind, &error))?;
    if bytes.len() == count {
        Ok(bytes)
    } else {
        Err(Malformed(format!(
            "its {kind} stream ends after {} of {count} bytes; the file is truncated, copy it again",
            bytes.len()
        )))
    }
}

fn damaged(kind: &str, error: &dyn std::fmt::Display) -> Malformed {
    let reason: String = error.to_string().chars().filter(|c| !c.is_control()).take(80).collect();
    Malformed(format!("its {kind} stream is damaged ({reason}); copy the file again"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::Compression;
    use flate2::write::{DeflateEncoder, GzEncoder};
    use std::io::Write;

    #[test]
    fn a_bomb_gives_no_more_than_was_asked_for() {
        let zeros = vec![0; 10 << 20];
        let mut deflate = DeflateEncoder::new(Vec::new(), Compression::fast());
        deflate.write_all(&zeros).unwrap();
        assert_eq!(inflate(&deflate.finish().unwrap(), 1000).unwrap(), zeros[..1000]);
        let frame = ruzstd::encoding::compress_to_vec(&zeros[..], ruzstd::encoding::CompressionLevel::Fastest);
        assert_eq!(unzstd(&frame, 1000).unwrap(), zeros[..1000]);
        assert!(
            unzstd(&frame, (10 << 20) + 1)
                .unwrap_err()
                .to_string()
                .contains("ends after")
        );
        let mut gzip = GzEncoder::new(Vec::new(), Compression::fast());
        gzip.write_all(&zeros).unwrap();
        let packed = gzip.finish().unwrap();
        let mut stream = Gunzip::new(&packed);
        assert_eq!(stream.take(16).unwrap(), [0; 16]);
        stream.finish().unwrap();
        let mut damaged = packed.clone();
        damaged.truncate(packed.len() / 2);
        assert!(Gunzip::new(&damaged).take(10 << 20).is_err());
    }

    #[test]
    fn a_wrong_checksum_is_noticed() {
        let mut gzip = GzEncoder::new(Vec::new(), Compression::fast());
        gzip.write_all(b"sixteen bytes...").unwrap();
        let mut packed = gzip.finish().unwrap();
        let crc = packed.len() - 6;
        packed[crc] ^= 1;
        let mut stream = Gunzip::new(&packed);
        stream.take(16).unwrap();
        assert!(stream.finish().unwrap_err().to_string().contains("damaged"));
    }
}
