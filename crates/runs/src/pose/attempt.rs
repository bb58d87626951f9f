//! One attempt to find poses: from photographs to models with one setting of features.

use super::capture::Capture;
use super::known::KnownPoses;
use super::stages::Work;
use super::{AttemptReport, MIN_POSED_FRACTION, PoseProgress, StageTimer};
use crate::RunError;
use irradia_sfm::PairMatches;
use irradia_sfm::map::{
    FEW_PHOTOS, MapOptions, PhotoInfo, Progress, Reconstruction, Turning, complete, extend, moving_matches, reconstruct,
};
use irradia_sfm::matching::PairOptions;
use std::path::Path;

/// Number of following frames with which each frame of a film is always matched.
const FILM_SUCCESSORS: usize = 10;
/// Minimum number of contradicting pairs of neighbours for the model of few photographs to be suspected of being wrong.
const MIN_CONTRADICTIONS: usize = 2;

/// Maximum number of photographs that are matched along epipolar lines, equal to the maximum number of frames chosen from films. For 984
/// frames of two films it took seven minutes and gave a model of 454 instead of 507, since what joins their parts was not filmed.
const MAX_GUIDED_PHOTOS: usize = 300;

/// Photographs with features and matches.
pub(super) struct Matched<'a> {
    pub work: Work<'a>,
    /// The photographs that have features, as the mapper needs them.
    pub infos: Vec<PhotoInfo>,
    pub pairs: Vec<PairMatches>,
    /// Whether what stands still is masked: some still features remain at the edges of the masks, and their matches are removed.
    pub masked: bool,
}

/// The result of one attempt.
pub(super) struct Attempt<'a> {
    pub matched: Matched<'a>,
    pub reconstruction: Reconstruction,
}

impl<'a> Matched<'a> {
    /// Finds features and matches of the photographs of `work`.
    pub fn find(mut work: Work<'a>, capture: &Capture, masked: bool, clock: &mut StageTimer) -> Result<Self, RunError> {
        work.find_features()?;
        clock.end("features");
        let pair_options = PairOptions {
            successors: if capture.has_films { FILM_SUCCESSORS } else { 0 },
            ..PairOptions::default()
        };
        let pairs = work.match_pairs(&pair_options)?;
        clock.end("matches");
        let infos = capture.infos(work.photos());
        let mut matched = Self {
            work,
            infos,
            pairs: Vec::new(),
            masked,
        };
        matched.set_pairs(pairs);
        Ok(matched)
    }

    fn set_pairs(&mut self, pairs: Vec<PairMatches>) {
        self.pairs = if self.masked {
            moving_matches(&self.infos, self.work.features(), &pairs)
        } else {
            pairs
        };
    }

    /// Models of the photographs, which are turned alike while they are mapped.
    fn models(&mut self, options: &MapOptions, on_progress: &mut dyn FnMut(Progress)) -> Reconstruction {
        let turning = Turning::apply(&mut self.infos, self.work.features_mut());
        let mut found = models(self, options, on_progress);
        turning.undo(
            &mut self.infos,
            self.work.features_mut(),
            &mut found,
            options,
            on_progress,
        );
        found
    }

    /// Models of the photographs, or poses for those that are not `known`.
    pub fn map(
        mut self,
        options: &MapOptions,
        known: Option<KnownPoses>,
        clock: &mut StageTimer,
        progress: &(dyn Fn(PoseProgress) + Sync),
    ) -> Result<Attempt<'a>, RunError> {
        let of = self.work.photos().len();
        let begin = || progress(PoseProgress::Stage { name: "poses", of });
        begin();
        let mut on_progress = |event| {
            if let Progress::Registered { photos, .. } = event {
                progress(PoseProgress::Done(photos));
            }
        };
        let is_new = known.is_none();
        let mut reconstruction = match known {
            None => self.models(options, &mut on_progress),
            Some(known) => {
                let Self { work, infos, pairs, .. } = &mut self;
                let known = known.geometry_of(infos)?;
                extend(infos, work.features(), pairs, &known, options, &mut on_progress)
            }
        };
        let unmatched = reconstruction.missing_and_unmatched(&self.pairs);
        if is_new && !unmatched.is_empty() {
            // With many photographs, not all pairs are matched at first: if too many matches are absent, the remaining pairs are matched
            // as well.
            let matched = self.pairs.iter().map(|pair| pair.photos);
            let mut all: Vec<[u32; 2]> = matched.chain(unmatched).collect();
            all.sort_unstable();
            let pairs = self.work.matches_of(all)?;
            self.set_pairs(pairs);
            begin();
            reconstruction = self.models(options, &mut on_progress);
        }
        clock.end("poses");
        Ok(Attempt {
            matched: self,
            reconstruction,
        })
    }
}

impl<'a> Attempt<'a> {
    /// Number of photographs with a pose in the largest model.
    pub fn registered(&self) -> usize {
        self.reconstruction.registered()
    }

    /// Number of pairs of neighbours that contradict the model of few photographs.
    fn contradictions(&self) -> usize {
        let Matched { work, infos, .. } = &self.matched;
        self.reconstruction.contradictions(infos, work.features())
    }

    /// This attempt's entry in the report.
    pub fn report(&self) -> AttemptReport {
        AttemptReport {
            max_features: self.matched.work.sift().max_features,
            frontal: self.matched.work.sift().frontal,
            registered: self.registered(),
            warnings: self.matched.work.warnings().to_vec(),
        }
    }

    /// Why a second attempt is made: too few photographs have a pose, or pairs of few photographs contradict the model. `None` if parts
    /// that look alike were mapped separately: a second attempt would only confuse them again.
    pub fn retry_reason(&self) -> Option<String> {
        let photos = self.matched.work.photos().len();
        if self.reconstruction.split_models.is_some() {
            return None;
        }
        if self.registered() < min_registered(photos) {
            return Some(format!("{} of {photos} photographs have a pose", self.registered()));
        }
        let pairs = self.contradictions();
        (pairs >= MIN_CONTRADICTIONS).then(|| format!("{pairs} pairs of photographs contradict the others"))
    }

    /// The same photographs for a second attempt, with frontal descriptors and matching along epipolar lines.
    pub fn retry(&self, wanted: Option<usize>, out: &Path) -> Work<'a> {
        let photos = self.matched.work.photos().len();
        let posed = self.reconstruction.models.first().map(|model| &model.poses);
        let left_out = (0..photos).filter(|i| posed.is_none_or(|poses| poses[*i].is_none()));
        self.matched.work.retry(wanted, &left_out.collect::<Vec<_>>(), out)
    }

    /// Whether this second attempt replaces the `first`. Its weak matches can give wrong models of few photographs (3 of 20 of a room
    /// photographed from one place, two opposite walls of a house as one) and add single photographs of parts that look alike.
    pub fn replaces(&self, first: &Self) -> bool {
        let photos = self.matched.work.photos().len();
        if self.registered() >= photos.div_ceil(2).max(first.registered() + photos.div_ceil(20)) {
            return true;
        }
        let contradicted = first.contradictions();
        contradicted >= MIN_CONTRADICTIONS
            && 2 * self.contradictions() <= contradicted
            && self.registered() >= first.registered()
    }
}

/// Whether this many photographs are matched along epipolar lines in a second attempt.
pub(super) fn can_be_guided(photos: usize) -> bool {
    photos <= MAX_GUIDED_PHOTOS
}

/// How many of this many photographs should have a pose.
fn min_registered(photos: usize) -> usize {
    match photos {
        ..=FEW_PHOTOS => photos,
        _ => (MIN_POSED_FRACTION * photos as f64).ceil() as usize,
    }
}

/// Models of photographs without known poses. In a second attempt, if too few photographs have a pose, matches along epipolar lines are
/// added. If the model contains half of the photographs, or 0.8 of few, these weak matches might break it, so they only register
/// photographs without a pose: mapping everything again took 195 s for 201 frames of a copier, 145 of them with a pose, and gave twelve
/// models of 23 to 65 frames, none of which was used; for 24 photographs of a can, 23 of them with a pose, it took 45 s, and none was
/// gained. Narrow views are tried in the first attempt only.
fn models(matched: &Matched, options: &MapOptions, on_progress: &mut dyn FnMut(Progress)) -> Reconstruction {
    let Matched { work, infos, pairs, .. } = matched;
    let is_second = work.sift().frontal;
    let unguided = MapOptions {
        narrow: options.narrow && !is_second,
        ..*options
    };
    let found = reconstruct(infos, work.features(), pairs, &unguided, on_progress);
    if !is_second || found.registered() >= min_registered(infos.len()) || !can_be_guided(infos.len()) {
        return found;
    }
    let guided = MapOptions {
        guided: true,
        ..unguided
    };
    let min_fraction = if infos.len() > FEW_PHOTOS {
        0.5
    } else {
        MIN_POSED_FRACTION
    };
    let is_mostly_mapped =
        found.registered() as f64 >= min_fraction * infos.len() as f64 && found.split_models.is_none();
    let again = if is_mostly_mapped {
        complete(infos, work.features(), pairs, &found, &guided, on_progress)
    } else {
        reconstruct(infos, work.features(), pairs, &guided, on_progress)
    };
    if again.registered() > found.registered() {
        again
    } else {
        found
    }
}
