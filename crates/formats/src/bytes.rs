use crate::Malformed;
use crate::text::text;

/// Reads little-endian values from a byte slice; reading past its end is an error that names the position.
pub(crate) struct ByteReader<'a> {
    rest: &'a [u8],
    total: usize,
}

impl<'a> ByteReader<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        Self {
            rest: bytes,
            total: bytes.len(),
        }
    }

    pub fn take(&mut self, count: usize) -> Result<&'a [u8], Malformed> {
        let Some((taken, rest)) = self.rest.split_at_checked(count) else {
            return Err(Malformed(format!(
                "ends too early: {count} bytes are needed at byte {} and {} are left; the file is truncated, copy it again",
                self.total - self.rest.len(),
                self.rest.len()
            )));
        };
        self.rest = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], Malformed> {
        Ok(self.take(N)?.try_into().expect("took N"))
    }

    pub fn u8(&mut self) -> Result<u8, Malformed> {
        Ok(self.array::<1>()?[0])
    }

    pub fn u16(&mut self) -> Result<u16, Malformed> {
        Ok(u16::from_le_bytes(self.array()?))
    }

    pub fn u32(&mut self) -> Result<u32, Malformed> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    pub fn u64(&mut self) -> Result<u64, Malformed> {
        Ok(u64::from_le_bytes(self.array()?))
    }

    pub fn f64(&mut self) -> Result<f64, Malformed> {
        Ok(f64::from_le_bytes(self.array()?))
    }

    pub fn f64s<const N: usize>(&mut self) -> Result<[f64; N], Malformed> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64()?;
        }
        Ok(values)
    }

    /// Whether all bytes are read.
    pub fn is_empty(&self) -> bool {
        self.rest.is_empty()
    }

    /// Bytes up to and including a zero, as [`crate::text::text`] reads them: on Windows, names may be in its code page.
    pub fn text(&mut self) -> Result<String, Malformed> {
        let length = self.rest.iter().position(|byte| *byte == 0).unwrap_or(self.rest.len());
        let text = text(self.take(length)?).into_owned();
        self.u8()?;
        Ok(text)
    }

    /// Bytes up to and including a line feed; invalid UTF-8 is replaced.
    pub fn line(&mut self) -> Result<String, Malformed> {
        let length = self
            .rest
            .iter()
            .position(|byte| *byte == b'\n')
            .unwrap_or(self.rest.len());
        let text = String::from_utf8_lossy(self.take(length)?).into_owned();
        self.u8()?;
        Ok(text)
    }

    /// A u64 count of records of at least `min_record_bytes` bytes each, checked against the remaining bytes before any allocation.
    pub fn count(&mut self, min_record_bytes: usize, label: &str) -> Result<usize, Malformed> {
        let declared = self.u64()?;
        let max_count = self.rest.len() / min_record_bytes;
        match usize::try_from(declared) {
            Ok(count) if count <= max_count => Ok(count),
            _ => Err(Malformed(format!(
                "declares {declared} {label}, but the {} bytes that follow hold at most {max_count}; the file is damaged",
                self.rest.len()
            ))),
        }
    }
}
