//! The PLY container: the header, and the rows of one element as fixed-size scalars, whatever the encoding.

use crate::Malformed;
use irradia_scene::Scalar;
use std::borrow::Cow;

/// A header is a few kilobytes; a file without `end_header` is not searched to its end.
pub(crate) const MAX_HEADER_BYTES: usize = 1 << 20;

/// The type that has this name in a header.
fn scalar_of(name: &str) -> Option<Scalar> {
    Some(match name {
        "char" | "int8" => Scalar::I8,
        "uchar" | "uint8" => Scalar::U8,
        "short" | "int16" => Scalar::I16,
        "ushort" | "uint16" => Scalar::U16,
        "int" | "int32" => Scalar::I32,
        "uint" | "uint32" => Scalar::U32,
        "float" | "float32" => Scalar::F32,
        "double" | "float64" => Scalar::F64,
        _ => return None,
    })
}

/// The name of a type in a header.
pub(crate) fn name_of(scalar: Scalar) -> &'static str {
    match scalar {
        Scalar::I8 => "char",
        Scalar::U8 => "uchar",
        Scalar::I16 => "short",
        Scalar::U16 => "ushort",
        Scalar::I32 => "int",
        Scalar::U32 => "uint",
        Scalar::F32 => "float",
        Scalar::F64 => "double",
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

#[derive(Clone, Copy, Debug)]
enum PropertyKind {
    Scalar(Scalar),
    List { count: Scalar, item: Scalar },
}

#[derive(Clone, Debug)]
struct Property {
    name: String,
    kind: PropertyKind,
}

#[derive(Clone, Debug)]
struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

impl Element {
    /// Bytes of a binary row if no property is a list.
    fn fixed_stride(&self) -> Option<usize> {
        self.properties.iter().try_fold(0, |sum, property| match property.kind {
            PropertyKind::Scalar(scalar) => Some(sum + scalar.size()),
            PropertyKind::List { .. } => None,
        })
    }

    /// Minimum length of a row: bytes (binary) or characters (ASCII, a digit and a separator per value).
    fn min_row_size(&self, encoding: Encoding) -> u64 {
        let min_size = |property: &Property| match (encoding, property.kind) {
            (Encoding::Ascii, _) => 2,
            (_, PropertyKind::Scalar(scalar)) => scalar.size(),
            (_, PropertyKind::List { count, .. }) => count.size(),
        };
        self.properties.iter().map(min_size).sum::<usize>() as u64
    }
}

/// A parsed header with the bytes after it.
pub(crate) struct Ply<'a> {
    encoding: Encoding,
    pub comments: Vec<String>,
    elements: Vec<Element>,
    body: &'a [u8],
}

/// The scalar properties of one element, each row `stride` bytes.
pub(crate) struct Rows<'a> {
    bytes: Cow<'a, [u8]>,
    stride: usize,
    columns: Vec<(String, Column)>,
}

/// Position and type of a property in a row.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Column {
    offset: usize,
    pub scalar: Scalar,
    big_endian: bool,
}

impl<'a> Ply<'a> {
    pub fn parse(bytes: &'a [u8]) -> Result<Self, Malformed> {
        let mut rest = bytes;
        if next_line(&mut rest).as_deref() != Some("ply") {
            return Err(Malformed("not a PLY file: its first line is not `ply`".into()));
        }
        let mut encoding = None;
        let mut comments = Vec::new();
        let mut elements: Vec<Element> = Vec::new();
        loop {
            let Some(line) = next_line(&mut rest).filter(|_| bytes.len() - rest.len() <= MAX_HEADER_BYTES) else {
                return Err(Malformed(
                    "the PLY header has no `end_header`; the file is damaged".into(),
                ));
            };
            let invalid_line = || Malformed(format!("the PLY header line `{}` is not understood", excerpt(&line)));
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            match words[..] {
                ["end_header"] => break,
                ["comment" | "obj_info", ..] => comments.push(line.split_once(' ').map_or("", |(_, c)| c).to_owned()),
                ["format", name, _] => {
                    encoding = Some(match name {
                        "ascii" => Encoding::Ascii,
                        "binary_little_endian" => Encoding::LittleEndian,
                        "binary_big_endian" => Encoding::BigEndian,
                        _ => return Err(invalid_line()),
                    });
                }
                ["element", name, count] => elements.push(Element {
                    name: name.to_owned(),
                    count: count.parse().map_err(|_| invalid_line())?,
                    properties: Vec::new(),
                }),
                ["property", "list", count, item, name] => {
                    let count = scalar_of(count).filter(|c| !c.is_float()).ok_or_else(invalid_line)?;
                    let item = scalar_of(item).ok_or_else(invalid_line)?;
                    elements.last_mut().ok_or_else(invalid_line)?.properties.push(Property {
                        name: name.to_owned(),
                        kind: PropertyKind::List { count, item },
                    });
                }
                ["property", scalar, name] => {
                    let scalar = scalar_of(scalar).ok_or_else(invalid_line)?;
                    elements.last_mut().ok_or_else(invalid_line)?.properties.push(Property {
                        name: name.to_owned(),
                        kind: PropertyKind::Scalar(scalar),
                    });
                }
                [] => {}
                _ => return Err(invalid_line()),
            }
        }
        Ok(Self {
            encoding: encoding.ok_or_else(|| Malformed("the PLY header has no `format` line".into()))?,
            comments,
            elements,
            body: rest,
        })
    }

    fn find(&self, element: &str) -> Result<&Element, Malformed> {
        let found = self.elements.iter().find(|e| e.name == element);
        found.ok_or_else(|| Malformed(format!("the PLY header declares no element `{element}`")))
    }

    /// Whether the header declares `element`.
    pub fn has(&self, element: &str) -> bool {
        self.elements.iter().any(|e| e.name == element)
    }

    /// Names of an element's properties, in order.
    pub fn property_names(&self, element: &str) -> Result<impl Iterator<Item = &str>, Malformed> {
        Ok(self.find(element)?.properties.iter().map(|p| p.name.as_str()))
    }

    /// Names of an element's properties and whether they are lists, in order.
    pub fn properties(&self, element: &str) -> Result<impl Iterator<Item = (&str, bool)>, Malformed> {
        let is_list = |property: &Property| matches!(property.kind, PropertyKind::List { .. });
        let properties = self.find(element)?.properties.iter();
        Ok(properties.map(move |property| (property.name.as_str(), is_list(property))))
    }

    /// The scalar properties of `element`; lists in it and all elements before it are skipped.
    pub fn rows(&self, element: &str) -> Result<Rows<'a>, Malformed> {
        let wanted = self.find(element)?;
        let mut rest = self.body;
        let before = self.elements.iter().take_while(|e| e.name != wanted.name);
        // Rows without properties take no space, however many are declared.
        for before in before.filter(|e| !e.properties.is_empty()) {
            self.check_size(before, rest)?;
            match (self.encoding, before.fixed_stride()) {
                (Encoding::Ascii, _) => scan_ascii(before, &mut rest, None)?,
                (_, Some(stride)) => rest = &rest[before.count as usize * stride..],
                (_, None) => self.scan_binary(before, &mut rest, None)?,
            }
        }
        if wanted.properties.is_empty() {
            return Err(Malformed(format!("the element `{element}` has no properties")));
        }
        self.check_size(wanted, rest)?;
        let count = wanted.count as usize;
        let mut columns = Vec::new();
        let mut stride = 0;
        let big_endian = self.encoding == Encoding::BigEndian;
        for property in &wanted.properties {
            if let PropertyKind::Scalar(scalar) = property.kind {
                let column = Column {
                    offset: stride,
                    scalar,
                    big_endian,
                };
                columns.push((property.name.clone(), column));
                stride += scalar.size();
            }
        }
        let bytes = match (self.encoding, wanted.fixed_stride()) {
            (Encoding::Ascii, _) => {
                let mut packed = Vec::new();
                scan_ascii(wanted, &mut rest, Some(&mut packed))?;
                Cow::Owned(packed)
            }
            (_, Some(stride)) => Cow::Borrowed(&rest[..count * stride]),
            (_, None) => {
                let mut packed = Vec::new();
                self.scan_binary(wanted, &mut rest, Some(&mut packed))?;
                Cow::Owned(packed)
            }
        };
        Ok(Rows { bytes, stride, columns })
    }

    fn check_size(&self, element: &Element, rest: &[u8]) -> Result<(), Malformed> {
        // The last number of an ASCII file needs no separator.
        let available = rest.len() as u64 + u64::from(self.encoding == Encoding::Ascii);
        let needed = u128::from(element.count) * u128::from(element.min_row_size(self.encoding));
        if needed > u128::from(available) {
            return Err(Malformed(format!(
                "the PLY header declares {} rows of `{}`, which take at least {needed} bytes, and the file has {} left; \
                 it is truncated, copy it again",
                element.count,
                element.name,
                rest.len()
            )));
        }
        Ok(())
    }

    fn scan_binary(
        &self,
        element: &Element,
        rest: &mut &[u8],
        mut packed: Option<&mut Vec<u8>>,
    ) -> Result<(), Malformed> {
        let mut take = |count: usize| -> Result<&[u8], Malformed> {
            let (taken, left) = rest.split_at_checked(count).ok_or_else(|| truncated(element))?;
            *rest = left;
            Ok(taken)
        };
        for _ in 0..element.count {
            for property in &element.properties {
                match property.kind {
                    PropertyKind::Scalar(scalar) => {
                        let taken = take(scalar.size())?;
                        if let Some(packed) = packed.as_deref_mut() {
                            packed.extend_from_slice(taken);
                        }
                    }
                    PropertyKind::List { count, item } => {
                        let column = Column {
                            offset: 0,
                            scalar: count,
                            big_endian: self.encoding == Encoding::BigEndian,
                        };
                        let length = column.f64(take(count.size())?);
                        // A negative length saturates to 0, one beyond the file is refused by `take`.
                        take((length as usize).saturating_mul(item.size()))?;
                    }
                }
            }
        }
        Ok(())
    }
}

impl Rows<'_> {
    pub fn len(&self) -> usize {
        self.bytes.len().checked_div(self.stride).unwrap_or(0)
    }

    pub fn row(&self, index: usize) -> &[u8] {
        &self.bytes[index * self.stride..(index + 1) * self.stride]
    }

    /// All columns with their names, in order.
    pub fn named_columns(&self) -> impl Iterator<Item = (&str, Column)> {
        self.columns.iter().map(|(name, column)| (name.as_str(), *column))
    }

    pub fn column(&self, name: &str) -> Option<Column> {
        self.columns.iter().find(|(n, _)| n == name).map(|(_, c)| *c)
    }

    /// The columns of `names`, or an error that lists the missing ones.
    pub fn columns<const N: usize>(&self, names: [&str; N]) -> Result<[Column; N], Malformed> {
        let missing: Vec<&str> = names.into_iter().filter(|name| self.column(name).is_none()).collect();
        if !missing.is_empty() {
            return Err(Malformed(format!(
                "the vertices lack the properties {}",
                missing.join(", ")
            )));
        }
        Ok(names.map(|name| self.column(name).expect("checked above")))
    }
}

impl Column {
    /// The value in `row`. Floats are preserved bit for bit, including NaNs; integers are converted, doubles rounded.
    pub fn f32(self, row: &[u8]) -> f32 {
        match self.scalar {
            Scalar::F32 => f32::from_bits(u32::from_ne_bytes(self.native(row))),
            _ => self.f64(row) as f32,
        }
    }

    /// The value in `row` as bits; types other than `uint` are converted.
    pub fn u32(self, row: &[u8]) -> u32 {
        match self.scalar {
            Scalar::U32 => u32::from_ne_bytes(self.native(row)),
            _ => self.f64(row) as u32,
        }
    }

    pub fn f64(self, row: &[u8]) -> f64 {
        match self.scalar {
            Scalar::I8 => f64::from(i8::from_ne_bytes(self.native(row))),
            Scalar::U8 => f64::from(u8::from_ne_bytes(self.native(row))),
            Scalar::I16 => f64::from(i16::from_ne_bytes(self.native(row))),
            Scalar::U16 => f64::from(u16::from_ne_bytes(self.native(row))),
            Scalar::I32 => f64::from(i32::from_ne_bytes(self.native(row))),
            Scalar::U32 => f64::from(u32::from_ne_bytes(self.native(row))),
            Scalar::F32 => f64::from(f32::from_ne_bytes(self.native(row))),
            Scalar::F64 => f64::from_ne_bytes(self.native(row)),
        }
    }

    /// Appends the value in `row`, little endian.
    pub fn append_to(self, bytes: &mut Vec<u8>, row: &[u8]) {
        let (start, value) = (bytes.len(), &row[self.offset..self.offset + self.scalar.size()]);
        bytes.extend_from_slice(value);
        if self.big_endian {
            bytes[start..].reverse();
        }
    }

    fn native<const N: usize>(self, row: &[u8]) -> [u8; N] {
        let mut bytes: [u8; N] = row[self.offset..self.offset + N].try_into().expect("N bytes");
        if self.big_endian != cfg!(target_endian = "big") {
            bytes.reverse();
        }
        bytes
    }
}

fn scan_ascii(element: &Element, rest: &mut &[u8], mut packed: Option<&mut Vec<u8>>) -> Result<(), Malformed> {
    let mut next = || -> Result<&str, Malformed> {
        let text = rest.trim_ascii_start();
        let length = text.iter().position(u8::is_ascii_whitespace).unwrap_or(text.len());
        let (word, left) = text.split_at(length);
        *rest = left;
        match std::str::from_utf8(word) {
            Ok("") => Err(truncated(element)),
            Ok(word) => Ok(word),
            Err(_) => Err(Malformed(format!(
                "the ASCII rows of `{}` contain something that is not a number",
                element.name
            ))),
        }
    };
    for _ in 0..element.count {
        for property in &element.properties {
            match property.kind {
                PropertyKind::Scalar(scalar) => {
                    let word = next()?;
                    if let Some(packed) = packed.as_deref_mut() {
                        push_number(packed, scalar, word)?;
                    }
                }
                PropertyKind::List { .. } => {
                    let word = next()?;
                    let length: u64 = word.parse().map_err(|_| not_a_number(word))?;
                    for _ in 0..length {
                        next()?;
                    }
                }
            }
        }
    }
    Ok(())
}

/// Appends the little-endian bytes of a number in text form.
fn push_number(packed: &mut Vec<u8>, scalar: Scalar, word: &str) -> Result<(), Malformed> {
    if scalar == Scalar::F32 {
        // Not via f64: rounding twice may miss the nearest float.
        let value: f32 = word.parse().map_err(|_| not_a_number(word))?;
        packed.extend_from_slice(&value.to_le_bytes());
        return Ok(());
    }
    let value: f64 = word.parse().map_err(|_| not_a_number(word))?;
    match scalar {
        Scalar::I8 => packed.extend_from_slice(&(value as i8).to_le_bytes()),
        Scalar::U8 => packed.extend_from_slice(&(value as u8).to_le_bytes()),
        Scalar::I16 => packed.extend_from_slice(&(value as i16).to_le_bytes()),
        Scalar::U16 => packed.extend_from_slice(&(value as u16).to_le_bytes()),
        Scalar::I32 => packed.extend_from_slice(&(value as i32).to_le_bytes()),
        Scalar::U32 => packed.extend_from_slice(&(value as u32).to_le_bytes()),
        Scalar::F32 | Scalar::F64 => packed.extend_from_slice(&value.to_le_bytes()),
    }
    Ok(())
}

/// The next line of a header, without white space at its end. Comments may be in any encoding: what is not UTF-8 is replaced.
fn next_line<'a>(rest: &mut &'a [u8]) -> Option<Cow<'a, str>> {
    let end = rest.iter().take(MAX_HEADER_BYTES).position(|byte| *byte == b'\n')?;
    let line = String::from_utf8_lossy(rest[..end].trim_ascii_end());
    *rest = &rest[end + 1..];
    Some(line)
}

fn excerpt(text: &str) -> String {
    text.chars().take(60).filter(|c| !c.is_control()).collect()
}

fn not_a_number(word: &str) -> Malformed {
    Malformed(format!("`{}` is not a number", excerpt(word)))
}

fn truncated(element: &Element) -> Malformed {
    Malformed(format!(
        "ends within the {} rows of `{}` that the header declares; the file is truncated, copy it again",
        element.count, element.name
    ))
}
