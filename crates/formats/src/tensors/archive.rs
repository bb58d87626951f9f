//! Zip archives as PyTorch writes them: all files stored, none compressed, so that no file is larger than the archive.
//! APPNOTE.TXT of PKWARE, sections 4.3.7, 4.3.12 and 4.3.16.

use crate::Malformed;
use crate::bytes::Bytes;
use std::collections::HashMap;

/// Signature and fixed part of the end-of-archive record, and its maximum comment length.
const END: &[u8] = b"PK\x05\x06";
const END_LENGTH: usize = 22;
const MAX_COMMENT: usize = 0xffff;

/// The files of the archive by name.
pub(super) fn files(archive: &[u8]) -> Result<HashMap<String, &[u8]>, Malformed> {
    let wrong = |what: &str| Malformed(format!("not a usable zip archive: {what}"));
    let last = archive.len().checked_sub(END_LENGTH);
    let last = last.ok_or_else(|| wrong("it is too short"))?;
    let first = last.saturating_sub(MAX_COMMENT);
    let end = (first..=last).rev().find(|at| archive[*at..].starts_with(END));
    let end = end.ok_or_else(|| wrong("its end is missing; the file is truncated, copy it again"))?;
    let mut record = Bytes::new(&archive[end + 10..]);
    let [count, _, start] = [u32::from(record.u16()?), record.u32()?, record.u32()?];
    let directory = archive.get(start as usize..end);
    let mut directory = Bytes::new(directory.ok_or_else(|| wrong("its directory is beyond its end"))?);
    let mut files = HashMap::new();
    for _ in 0..count {
        // Signature, versions, flags; then method, time, checksum, sizes, lengths of the name and of what follows it.
        if directory.take(4)? != b"PK\x01\x02" {
            return Err(wrong("its directory is damaged"));
        }
        directory.take(6)?;
        let method = directory.u16()?;
        directory.take(8)?;
        let [packed, size] = [directory.u32()?, directory.u32()?];
        let [name, extra, comment] = [directory.u16()?, directory.u16()?, directory.u16()?];
        directory.take(8)?;
        let at = directory.u32()? as usize;
        let name = String::from_utf8_lossy(directory.take(name.into())?).into_owned();
        directory.take(usize::from(extra) + usize::from(comment))?;
        if method != 0 || packed != size {
            return Err(wrong(&format!("{name} is compressed, which PyTorch does not do")));
        }
        let mut local = Bytes::new(archive.get(at..).ok_or_else(|| wrong("a file is beyond its end"))?);
        if local.take(4)? != b"PK\x03\x04" {
            return Err(wrong(&format!("{name} is not where the directory says")));
        }
        local.take(22)?;
        let [name_length, extra] = [local.u16()?, local.u16()?];
        local.take(usize::from(name_length) + usize::from(extra))?;
        files.insert(name, local.take(size as usize)?);
    }
    Ok(files)
}
