//! Sizes of memory and files.

/// Bytes of memory: as [`file_size`], but a letter alone is a power of 1024, such as `8G`.
pub fn memory_size(text: &str) -> Result<usize, String> {
    Ok(parse(text, 1024.0)? as usize)
}

/// Bytes of `10MB`, `800kB`, `1.5GiB` or `4096`. A letter alone is a power of 1000, such as `10M`.
pub fn file_size(text: &str) -> Result<u64, String> {
    parse(text, 1000.0)
}

/// A number with a unit: powers of 1000 with a `B`, of 1024 with `iB`, of `base` with neither.
fn parse(text: &str, base: f64) -> Result<u64, String> {
    let end = text
        .find(|c: char| !(c.is_ascii_digit() || c == '.'))
        .unwrap_or(text.len());
    let unit = text[end..].trim().to_lowercase();
    let (prefix, base) = match (unit.strip_suffix("ib"), unit.strip_suffix('b')) {
        (Some(prefix), _) => (prefix, 1024.0),
        (None, Some(prefix)) => (prefix, 1000.0),
        (None, None) => (unit.as_str(), base),
    };
    let power = ["", "k", "m", "g", "t"].iter().position(|known| *known == prefix);
    match (text[..end].parse::<f64>(), power) {
        (Ok(number), Some(power)) if number > 0.0 => Ok((number * base.powi(power as i32)) as u64),
        _ => Err("expected a size such as 8GiB or 500MB".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_unit_says_whether_it_is_a_power_of_1000_or_of_1024() {
        for (text, file, memory) in [
            ("10MB", 10_000_000, 10_000_000),
            ("800kB", 800_000, 800_000),
            ("8 GiB", 8 << 30, 8 << 30),
            ("1.5g", 1_500_000_000, 3 << 29),
            ("512K", 512_000, 512 << 10),
            ("4096", 4096, 4096),
        ] {
            assert_eq!((file_size(text), memory_size(text)), (Ok(file), Ok(memory)), "{text}");
        }
        for wrong in ["", "ten", "10 apples", "0", "-1GB", "MB"] {
            assert!(file_size(wrong).is_err(), "{wrong}");
        }
    }
}
