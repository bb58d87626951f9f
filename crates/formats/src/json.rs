//! JSON as programs write it.

use crate::Malformed;
use crate::text::text;
use serde::de::DeserializeOwned;

/// Parses JSON, with or without a byte order mark. `NaN` and `Infinity`, which are not JSON but written by Python, are read as `null`.
///
/// # Errors
/// When it is not JSON of that structure: no usable `kind`, with line and column.
pub(crate) fn parse_json<T: DeserializeOwned>(bytes: &[u8], kind: &str) -> Result<T, Malformed> {
    let text = text(bytes);
    serde_json::from_str(&text).or_else(|error| {
        let replaced = nulls_for_python_numbers(text.as_bytes());
        serde_json::from_slice(&replaced).map_err(|_| Malformed(format!("not a usable {kind}: {error}")))
    })
}

/// `null` for each `NaN`, `Infinity` and `-Infinity` outside strings.
fn nulls_for_python_numbers(bytes: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(bytes.len());
    let mut in_string = false;
    let mut rest = bytes;
    while let Some((first, after)) = rest.split_first() {
        if !in_string
            && let Some(after) = [&b"NaN"[..], b"-NaN", b"Infinity", b"-Infinity"]
                .iter()
                .find_map(|word| rest.strip_prefix(*word))
        {
            out.extend(b"null");
            rest = after;
            continue;
        }
        out.push(*first);
        rest = after;
        match first {
            b'"' => in_string = !in_string,
            b'\\' if in_string => {
                if let Some((escaped, after)) = rest.split_first() {
                    out.push(*escaped);
                    rest = after;
                }
            }
            _ => {}
        }
    }
    out
}
