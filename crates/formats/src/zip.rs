//! Zip archives: reads stored or deflated files by name, and writes archives of stored files.
//! APPNOTE.TXT of PKWARE, sections 4.3.7, 4.3.12 and 4.3.16. Names are never used as paths: nothing is extracted to disk.

use crate::Malformed;
use crate::bytes::ByteReader;
use crate::unpack::inflate;
use flate2::Crc;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{self, Write};

/// Signature and fixed part of the end-of-archive record, and its maximum comment length.
const END_SIGNATURE: &[u8] = b"PK\x05\x06";
const END_RECORD_BYTES: usize = 22;
const MAX_COMMENT_BYTES: usize = 0xffff;
/// Maximum compression ratio of deflate; a file that declares more is designed to exhaust memory.
const MAX_COMPRESSION_RATIO: usize = 1032;

/// A file in an archive.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Entry<'a> {
    packed: &'a [u8],
    size: usize,
    is_deflated: bool,
}

impl<'a> Entry<'a> {
    /// The content if it is not compressed.
    pub fn stored(&self) -> Option<&'a [u8]> {
        (!self.is_deflated).then_some(self.packed)
    }

    /// The content, of at most `max_size` bytes.
    pub fn content(&self, max_size: usize) -> Result<Cow<'a, [u8]>, Malformed> {
        if self.size > max_size.min(self.packed.len().saturating_mul(MAX_COMPRESSION_RATIO)) {
            return Err(Malformed(format!(
                "declares {} bytes, unpacked from {}; at most {max_size} are expected",
                self.size,
                self.packed.len()
            )));
        }
        if self.is_deflated {
            inflate(self.packed, self.size).map(Cow::Owned)
        } else {
            Ok(Cow::Borrowed(self.packed))
        }
    }
}

/// The files of the archive, in the order of their names.
pub(crate) fn files(archive: &[u8]) -> Result<BTreeMap<String, Entry<'_>>, Malformed> {
    let malformed = |reason: &str| Malformed(format!("not a usable zip archive: {reason}"));
    let last = archive.len().checked_sub(END_RECORD_BYTES);
    let last = last.ok_or_else(|| malformed("it is too short"))?;
    let first = last.saturating_sub(MAX_COMMENT_BYTES);
    let end = (first..=last)
        .rev()
        .find(|at| archive[*at..].starts_with(END_SIGNATURE));
    let end = end.ok_or_else(|| malformed("its end is missing; the file is truncated, copy it again"))?;
    let mut record = ByteReader::new(&archive[end + 10..]);
    let [count, _, start] = [u32::from(record.u16()?), record.u32()?, record.u32()?];
    let directory = archive.get(start as usize..end);
    let mut directory = ByteReader::new(directory.ok_or_else(|| malformed("its directory is beyond its end"))?);
    let mut files = BTreeMap::new();
    for _ in 0..count {
        // Signature, versions, flags; then method, time, checksum, sizes, and the lengths of name, extra field and comment.
        if directory.take(4)? != b"PK\x01\x02" {
            return Err(malformed("its directory is damaged"));
        }
        directory.take(4)?;
        let flags = directory.u16()?;
        let method = directory.u16()?;
        directory.take(8)?;
        let [packed, size] = [directory.u32()?, directory.u32()?];
        let [name, extra, comment] = [directory.u16()?, directory.u16()?, directory.u16()?];
        directory.take(8)?;
        let local_offset = directory.u32()? as usize;
        let name = String::from_utf8_lossy(directory.take(name.into())?).into_owned();
        directory.take(usize::from(extra) + usize::from(comment))?;
        let is_deflated = method == 8;
        if flags & 1 != 0 || !is_deflated && (method != 0 || packed != size) {
            return Err(malformed(&format!(
                "{} is encrypted or compressed by a method that is not supported",
                printable(&name)
            )));
        }
        let mut local = ByteReader::new(
            archive
                .get(local_offset..)
                .ok_or_else(|| malformed("a file is beyond its end"))?,
        );
        if local.take(4)? != b"PK\x03\x04" {
            return Err(malformed(&format!(
                "{} is not where the directory says",
                printable(&name)
            )));
        }
        local.take(22)?;
        let [name_length, extra] = [local.u16()?, local.u16()?];
        local.take(usize::from(name_length) + usize::from(extra))?;
        let entry = Entry {
            packed: local.take(packed as usize)?,
            size: size as usize,
            is_deflated,
        };
        files.insert(name, entry);
    }
    Ok(files)
}

/// A name from a file, made safe to print.
pub(crate) fn printable(name: &str) -> String {
    name.chars().filter(|c| !c.is_control()).take(60).collect()
}

/// Writes an archive of stored files, one after another. The time is zip's earliest, so that the same content gives the same bytes.
pub(crate) struct Writer<'a> {
    out: &'a mut dyn Write,
    offset: u64,
    directory: Vec<u8>,
    files: u16,
}

impl<'a> Writer<'a> {
    pub fn new(out: &'a mut dyn Write) -> Self {
        Self {
            out,
            offset: 0,
            directory: Vec::new(),
            files: 0,
        }
    }

    /// Adds a file.
    ///
    /// # Errors
    /// When it cannot be written, or the archive exceeds the 4 GiB of the format's classic layout.
    pub fn add_file(&mut self, name: &str, content: &[u8]) -> io::Result<()> {
        // 1980-01-01, midnight.
        const DOS_TIME: [u8; 4] = [0, 0, 0x21, 0];
        let end = self.offset + (2 * name.len() + content.len() + 76 + END_RECORD_BYTES) as u64;
        if end + self.directory.len() as u64 > u64::from(u32::MAX) {
            return Err(io::Error::other(
                "a zip archive holds at most 4 GiB; choose another format",
            ));
        }
        let mut crc = Crc::new();
        crc.update(content);
        // Version 2.0, no flags, stored.
        let mut common = vec![20, 0, 0, 0, 0, 0];
        common.extend(DOS_TIME);
        common.extend(crc.sum().to_le_bytes());
        common.extend([content.len() as u32; 2].map(u32::to_le_bytes).as_flattened());
        common.extend((name.len() as u16).to_le_bytes());
        common.extend([0, 0]);
        let local_header = [&b"PK\x03\x04"[..], &common, name.as_bytes()].concat();
        self.out.write_all(&local_header)?;
        self.out.write_all(content)?;
        self.directory.extend_from_slice(b"PK\x01\x02\x14\x00");
        self.directory.extend_from_slice(&common);
        // Comment, disk, attributes.
        self.directory.extend([0; 10]);
        self.directory.extend((self.offset as u32).to_le_bytes());
        self.directory.extend_from_slice(name.as_bytes());
        self.offset += (local_header.len() + content.len()) as u64;
        self.files += 1;
        Ok(())
    }

    /// Writes the directory.
    pub fn finish(mut self) -> io::Result<()> {
        let size = self.directory.len() as u32;
        self.directory.extend_from_slice(END_SIGNATURE);
        self.directory.extend([0; 4]);
        self.directory
            .extend([self.files; 2].map(u16::to_le_bytes).as_flattened());
        self.directory.extend(size.to_le_bytes());
        self.directory.extend((self.offset as u32).to_le_bytes());
        self.directory.extend([0; 2]);
        self.out.write_all(&self.directory)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stored_files_come_back() {
        let mut bytes = Vec::new();
        let mut archive = Writer::new(&mut bytes);
        archive.add_file("a.txt", b"hello").unwrap();
        archive.add_file("dir/b", &[7; 1000]).unwrap();
        archive.finish().unwrap();
        let files = files(&bytes).unwrap();
        assert_eq!(files.len(), 2);
        assert_eq!(files["a.txt"].content(10).unwrap().as_ref(), b"hello");
        assert_eq!(files["dir/b"].stored().unwrap(), [7; 1000]);
        assert!(
            files["dir/b"]
                .content(999)
                .unwrap_err()
                .to_string()
                .contains("at most 999")
        );
    }
}
