//! Points with the photographs that see them.

use super::declared::DeclaredPoints;
use super::tokens::Tokens;
use crate::Malformed;
use std::collections::HashMap;
use std::hash::Hash;

/// A point: position, sRGB, and the keys of the photographs that see it.
pub type TrackPoint<K = usize> = ([f64; 3], [u8; 3], Vec<K>);

/// Reads a point of Bundler or VisualSfM: position, colour, the number of its views, and four words per view, the first of which is the photograph's number.
pub(super) fn parse_track_point(tokens: &mut Tokens) -> Result<TrackPoint, Malformed> {
    let position = tokens.numbers("a point")?;
    let color = tokens.numbers::<3>("a colour")?.map(|v| v as u8);
    let views: usize = tokens.next("a count of views")?;
    let mut seen_by = Vec::new();
    for _ in 0..views {
        seen_by.push(tokens.next("a view")?);
        tokens.skip(3, "a list of views")?;
    }
    Ok((position, color, seen_by))
}

/// The usable points, and the indices of those that each photograph sees, by its key.
pub(super) fn declared_points<K: Eq + Hash>(
    tracks: impl IntoIterator<Item = TrackPoint<K>>,
) -> (DeclaredPoints, HashMap<K, Vec<u32>>) {
    let mut points = DeclaredPoints::default();
    let mut seen: HashMap<K, Vec<u32>> = HashMap::new();
    for (position, color, photos) in tracks {
        let index = points.positions.len() as u32;
        if points.push(position.into(), color) {
            for photo in photos {
                seen.entry(photo).or_default().push(index);
            }
        }
    }
    (points, seen)
}
