//! COLMAP's `cameras.txt`, `images.txt` and `points3D.txt`.

use super::{ColmapCamera, ColmapImage, ColmapPoint};
use crate::Malformed;
use std::str::{FromStr, SplitAsciiWhitespace};

/// Parses `cameras.txt`: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS..`.
///
/// # Errors
/// When a line is invalid; it is named by number.
pub fn parse_cameras(bytes: &[u8]) -> Result<Vec<ColmapCamera>, Malformed> {
    let text = checked_text(bytes)?;
    content_lines(&text)
        .map(|(number, line)| {
            let mut words = Words::new(number, line);
            Ok(ColmapCamera {
                id: words.next("CAMERA_ID")?,
                model: words.next("MODEL")?,
                width: words.next("WIDTH")?,
                height: words.next("HEIGHT")?,
                params: words.rest("PARAMS")?,
            })
        })
        .collect()
}

/// Parses `images.txt`: a line `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, then a line of `X Y POINT3D_ID` triples,
/// which may be empty; some tools omit it.
///
/// # Errors
/// When a line is invalid; it is named by number.
pub fn parse_images(bytes: &[u8]) -> Result<Vec<ColmapImage>, Malformed> {
    let text = checked_text(bytes)?;
    let mut lines = text.lines().enumerate().peekable();
    let mut images = Vec::new();
    while let Some((index, line)) = lines.next() {
        if line.trim().is_empty() || line.trim_start().starts_with('#') {
            continue;
        }
        let mut words = Words::new(index + 1, line);
        words.next::<u64>("IMAGE_ID")?;
        let mut image = ColmapImage {
            rotation: words.floats("QW QX QY QZ")?,
            translation: words.floats("TX TY TZ")?,
            camera_id: words.next("CAMERA_ID")?,
            name: name_of(line).ok_or_else(|| words.malformed("NAME"))?.to_owned(),
            points: Vec::new(),
        };
        if let Some((index, line)) = lines.next_if(|(_, line)| is_observations(line)) {
            let mut words = Words::new(index + 1, line);
            while let Some(x) = words.next_word() {
                let _: f64 = words.parse(x, "X")?;
                words.next::<f64>("Y")?;
                // -1 if the observation belongs to no point.
                image
                    .points
                    .extend(u64::try_from(words.next::<i64>("POINT3D_ID")?).ok());
            }
        }
        images.push(image);
    }
    Ok(images)
}

/// Parses `points3D.txt`: `POINT3D_ID X Y Z R G B ERROR TRACK..`.
///
/// # Errors
/// When a line is invalid; it is named by number.
pub fn parse_points(bytes: &[u8]) -> Result<Vec<ColmapPoint>, Malformed> {
    let text = checked_text(bytes)?;
    content_lines(&text)
        .map(|(number, line)| {
            let mut words = Words::new(number, line);
            Ok(ColmapPoint {
                id: words.next("POINT3D_ID")?,
                position: words.floats("X Y Z")?,
                color: [words.next("R")?, words.next("G")?, words.next("B")?],
            })
        })
        .collect()
}

/// Everything after the ninth word: names may contain spaces.
fn name_of(line: &str) -> Option<&str> {
    let mut rest = line.trim();
    for _ in 0..9 {
        rest = rest.split_once(|c: char| c.is_ascii_whitespace())?.1.trim_start();
    }
    (!rest.is_empty()).then_some(rest)
}

/// Whether a line after an image contains its observations rather than the next image: these are three numbers each, and an image's tenth
/// word is a name, which may be a number.
fn is_observations(line: &str) -> bool {
    let words = || line.split_ascii_whitespace();
    !line.trim_start().starts_with('#')
        && words().take(10).all(|word| word.parse::<f64>().is_ok())
        && words().count().is_multiple_of(3)
}

fn content_lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let numbered = text.lines().enumerate().map(|(index, line)| (index + 1, line.trim()));
    numbered.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
}

fn checked_text(bytes: &[u8]) -> Result<std::borrow::Cow<'_, str>, Malformed> {
    if bytes.contains(&0) {
        return Err(Malformed(
            "contains zero bytes, so it is not text; is it a binary model under a .txt name?".into(),
        ));
    }
    Ok(crate::text::text(bytes))
}

/// The words of one line, with its number for errors.
struct Words<'a> {
    line: usize,
    words: SplitAsciiWhitespace<'a>,
}

impl<'a> Words<'a> {
    fn new(line: usize, text: &'a str) -> Self {
        Self {
            line,
            words: text.split_ascii_whitespace(),
        }
    }

    fn next_word(&mut self) -> Option<&'a str> {
        self.words.next()
    }

    fn next<T: FromStr>(&mut self, field: &str) -> Result<T, Malformed> {
        let word = self.words.next().unwrap_or("");
        self.parse(word, field)
    }

    fn floats<const N: usize>(&mut self, field: &str) -> Result<[f64; N], Malformed> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.next(field)?;
        }
        Ok(values)
    }

    fn rest(&mut self, field: &str) -> Result<Vec<f64>, Malformed> {
        let mut values = Vec::new();
        while let Some(word) = self.words.next() {
            values.push(self.parse(word, field)?);
        }
        Ok(values)
    }

    fn parse<T: FromStr>(&self, word: &str, field: &str) -> Result<T, Malformed> {
        word.parse().map_err(|_| self.malformed(field))
    }

    fn malformed(&self, field: &str) -> Malformed {
        Malformed(format!("line {}: {field} is missing or not understood", self.line))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_with_spaces_and_folders_empty_and_absent_observations() {
        let text = "# comment\n\
            1 1 0 0 0 0.5 0 0 3 left cam/my photo 1.jpg\n\n\
            2 1 0 0 0 1 0 0 3 b.jpg\n10.5 20.5 7 1 2 -1 3 4 9\n\
            3 1 0 0 0 2 0 0 3 c.jpg\n\
            4 nan 0 0 0 3 0 0 3 d.jpg\r\n\r\n";
        let images = parse_images(text.as_bytes()).unwrap();
        let names: Vec<&str> = images.iter().map(|i| i.name.as_str()).collect();
        assert_eq!(names, ["left cam/my photo 1.jpg", "b.jpg", "c.jpg", "d.jpg"]);
        assert_eq!(images[1].points, [7, 9]);
        assert!(images[3].rotation[0].is_nan());
        assert!(images.iter().all(|i| i.camera_id == 3));
    }

    #[test]
    fn errors_name_the_line() {
        let error = parse_cameras(b"# c\n1 PINHOLE 10 x 1 1 1 1\n").unwrap_err().to_string();
        assert!(error.contains("line 2") && error.contains("HEIGHT"), "{error}");
        assert!(parse_points(b"1 2 3\n").unwrap_err().to_string().contains("X Y Z"));
        assert!(
            parse_images(b"1 1 0 0 0 0 0 0 1\n")
                .unwrap_err()
                .to_string()
                .contains("NAME")
        );
        assert!(parse_cameras(b"\x01\0\0\0").unwrap_err().to_string().contains("binary"));
    }
}
