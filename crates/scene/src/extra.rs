//! Values that a file has for each splat but that are not rendered, kept for the next file.

/// The type of a number in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scalar {
    /// Signed, 8 bits.
    I8,
    /// Unsigned, 8 bits.
    U8,
    /// Signed, 16 bits.
    I16,
    /// Unsigned, 16 bits.
    U16,
    /// Signed, 32 bits.
    I32,
    /// Unsigned, 32 bits.
    U32,
    /// Floating point, 32 bits.
    F32,
    /// Floating point, 64 bits.
    F64,
}

impl Scalar {
    /// Number of bytes.
    pub fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Whether it is a floating-point type.
    pub fn is_float(self) -> bool {
        matches!(self, Self::F32 | Self::F64)
    }
}

/// A number for each splat that has a meaning only to the program that wrote it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExtraColumn {
    /// Its name in the file.
    pub name: String,
    /// Its type in the file.
    pub scalar: Scalar,
    /// The numbers, `[N]`, little endian.
    pub bytes: Vec<u8>,
}

impl ExtraColumn {
    /// `count` zeros in a column of the same name and type.
    pub fn zeros(&self, count: usize) -> Self {
        Self {
            name: self.name.clone(),
            scalar: self.scalar,
            bytes: vec![0; count * self.scalar.size()],
        }
    }

    /// Number of values.
    pub fn len(&self) -> usize {
        self.bytes.len() / self.scalar.size()
    }

    /// Whether it has no values.
    pub fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// The bytes of number `i`.
    pub fn get(&self, i: usize) -> &[u8] {
        &self.bytes[i * self.scalar.size()..][..self.scalar.size()]
    }

    /// The numbers `indices`, in that order.
    pub fn gather(&self, indices: &[u32]) -> Self {
        let numbers = indices.iter().flat_map(|i| self.get(*i as usize));
        Self {
            bytes: numbers.copied().collect(),
            ..self.zeros(0)
        }
    }

    /// Overwrites the numbers `indices` with those of `from`.
    pub fn scatter(&mut self, indices: &[u32], from: &Self) {
        let size = self.scalar.size();
        for (row, i) in indices.iter().enumerate() {
            self.bytes[*i as usize * size..][..size].copy_from_slice(from.get(row));
        }
    }

    /// Appends `count` numbers: those of the column of `others` with the same name and type, or zeros if there is none.
    pub fn append(&mut self, others: &[Self], count: usize) {
        match others.iter().find(|other| self.is_like(other)) {
            Some(other) => self.bytes.extend_from_slice(&other.bytes),
            None => self.bytes.resize(self.bytes.len() + count * self.scalar.size(), 0),
        }
    }

    /// Whether name and type are the same.
    pub fn is_like(&self, other: &Self) -> bool {
        self.name == other.name && self.scalar == other.scalar
    }
}
