//! Selection of points for an adjustment: long tracks determine poses best, and a few hundred per photograph are enough.

/// Those of `tracks`, longest first, that give each of the `photos` photographs at least `min_observations` where possible. `photos_of`
/// returns the photographs that show a track; of equally long tracks, the first is preferred.
pub(super) fn covering<P: Iterator<Item = usize>>(
    tracks: impl Iterator<Item = usize>,
    photos: usize,
    min_observations: usize,
    photos_of: impl Fn(usize) -> P,
) -> Vec<usize> {
    let mut order: Vec<(usize, usize)> = tracks.map(|track| (photos_of(track).count(), track)).collect();
    order.sort_by_key(|(length, track)| (std::cmp::Reverse(*length), *track));
    let mut counts = vec![0usize; photos];
    let mut chosen = Vec::new();
    for (_, track) in order {
        if photos_of(track).any(|photo| counts[photo] < min_observations) {
            photos_of(track).for_each(|photo| counts[photo] += 1);
            chosen.push(track);
        }
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_tracks_come_first_and_end_once_all_photographs_have_enough() {
        let tracks: [&[usize]; 5] = [&[0, 1], &[1, 2], &[0, 1, 2], &[2, 3], &[0, 1]];
        let chosen = |min_observations| covering(0..5, 4, min_observations, |track| tracks[track].iter().copied());
        assert_eq!(chosen(1), [2, 3]);
        assert_eq!(chosen(2), [2, 0, 1, 3]);
    }
}
