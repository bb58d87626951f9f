//! The doctor's diagnoses: one variant for each, with its evidence and one sentence.

use super::quality::MIN_FEATURE_RATIO;
use std::fmt::{self, Display, Formatter};

/// Minimum fraction of matches at rest for the camera itself to be at rest: people who walk in front of a camera on a tripod leave 98 %.
const MIN_STILL_CAMERA_FRACTION: f64 = 0.9;

/// The family of a diagnosis; tests and reports count diagnoses by family.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Kind {
    /// [`Diagnosis::Blurred`]
    Blurred,
    /// [`Diagnosis::ExposureJump`] and [`Diagnosis::Clipped`]
    Exposure,
    /// [`Diagnosis::FewFeatures`]
    FewFeatures,
    /// [`Diagnosis::Hidden`]
    Hidden,
    /// [`Diagnosis::Zoom`], [`Diagnosis::OwnFocals`] and [`Diagnosis::ZoomSettings`]
    Zoom,
    /// [`Diagnosis::Cropped`]
    Cropped,
    /// [`Diagnosis::FocalUnknown`]
    FocalUnknown,
    /// [`Diagnosis::SeparateParts`]
    SeparateParts,
    /// [`Diagnosis::Bridge`] and [`Diagnosis::CutPoint`]
    WeakLink,
    /// [`Diagnosis::FewPartners`]
    FewPartners,
    /// [`Diagnosis::Gap`]
    Gap,
    /// [`Diagnosis::OpenLoop`]
    OpenLoop,
    /// [`Diagnosis::RotationOnly`] and [`Diagnosis::RotationBetweenModels`]
    RotationOnly,
    /// [`Diagnosis::StillRegion`]
    StillRegion,
    /// [`Diagnosis::Moving`]
    Moving,
    /// [`Diagnosis::Duplicate`]
    Duplicate,
    /// [`Diagnosis::Contradiction`] and [`Diagnosis::OtherMotion`]
    Contradiction,
    /// [`Diagnosis::Missing`]
    Missing,
    /// [`Diagnosis::LeftOut`]
    LeftOut,
}

impl Kind {
    /// Its name in `doctor.json`.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Blurred => "blurred",
            Kind::Exposure => "exposure",
            Kind::FewFeatures => "few-features",
            Kind::Hidden => "hidden",
            Kind::Zoom => "zoom",
            Kind::Cropped => "cut",
            Kind::FocalUnknown => "focal-unknown",
            Kind::SeparateParts => "separate-parts",
            Kind::WeakLink => "weak-link",
            Kind::FewPartners => "few-partners",
            Kind::Gap => "gap",
            Kind::OpenLoop => "open-loop",
            Kind::RotationOnly => "rotation-only",
            Kind::StillRegion => "stands-still",
            Kind::Moving => "moving",
            Kind::Duplicate => "twice",
            Kind::Contradiction => "contradiction",
            Kind::Missing => "missing-matches",
            Kind::LeftOut => "left-out",
        }
    }
}

/// A fault of a capture, with its evidence. Photographs are indices.
#[derive(Clone, Debug, PartialEq)]
pub enum Diagnosis {
    /// Less sharp than photographs of the same part of the scene.
    Blurred {
        /// The photograph.
        photo: usize,
        /// How many times less sharp than the median of its neighbours.
        times: f64,
        /// Those neighbours.
        neighbours: Vec<usize>,
    },
    /// Brighter or darker than photographs of the same part of the scene.
    ExposureJump {
        /// The photograph.
        photo: usize,
        /// Difference from its neighbours, in stops; positive if brighter.
        stops: f64,
        /// Those neighbours.
        neighbours: Vec<usize>,
    },
    /// A large part is white or black, unlike in the others.
    Clipped {
        /// The photograph.
        photo: usize,
        /// Fraction of its pixels.
        fraction: f64,
        /// White rather than black.
        bright: bool,
    },
    /// Without texture.
    FewFeatures {
        /// The photograph.
        photo: usize,
        /// Its features.
        features: usize,
        /// The median over all photographs.
        median: usize,
    },
    /// Hidden by its mask, or transparent, except for too small a part.
    Hidden {
        /// The photograph.
        photo: usize,
        /// The fraction that is hidden.
        fraction: f64,
    },
    /// Taken with another focal length than the others of its camera.
    Zoom {
        /// The photographs of one focal length.
        photos: Vec<usize>,
        /// That focal length relative to the one of the others.
        ratio: f64,
    },
    /// The focal length differs from photograph to photograph and is not in the metadata.
    OwnFocals {
        /// The photographs with the shortest and the longest focal length.
        ends: [usize; 2],
        /// The longest relative to the shortest.
        ratio: f64,
    },
    /// The metadata have several focal lengths.
    ZoomSettings {
        /// Focal lengths, relative to the long side, each with its photographs.
        settings: Vec<(f64, Vec<usize>)>,
    },
    /// The principal point is away from the centre.
    Cropped {
        /// The photographs, those with the largest distance first.
        photos: Vec<usize>,
        /// The largest distance, px.
        distance: f64,
    },
    /// All focal lengths fit the matches equally well.
    FocalUnknown {
        /// Photographs of the camera.
        photos: Vec<usize>,
    },
    /// Parts of the capture without any overlap.
    SeparateParts {
        /// Photographs by part, largest first.
        parts: Vec<Vec<usize>>,
    },
    /// Two parts are connected by a single pair of photographs.
    Bridge {
        /// The pair.
        photos: [usize; 2],
        /// Photographs on each side.
        sides: [usize; 2],
    },
    /// Two parts are connected by a single photograph.
    CutPoint {
        /// The photograph.
        photo: usize,
        /// Photographs of the smaller part.
        behind: Vec<usize>,
    },
    /// Fewer than three partners.
    FewPartners {
        /// The photograph.
        photo: usize,
        /// Its partners.
        partners: Vec<usize>,
    },
    /// A stretch around the scene without photographs.
    Gap {
        /// The photographs on both sides.
        sides: [usize; 2],
        /// Its angle as seen from the centre, degrees.
        degrees: f64,
    },
    /// A loop of photographs around the scene whose ends do not overlap.
    OpenLoop {
        /// Both ends.
        ends: [usize; 2],
        /// The angle between them, degrees.
        degrees: f64,
    },
    /// Photographs from one place.
    RotationOnly {
        /// The photographs.
        photos: Vec<usize>,
        /// Pairs among them.
        pairs: usize,
    },
    /// Two models show the same part of the scene, but from one place.
    RotationBetweenModels {
        /// The photographs, one of each model, with most matches.
        ends: [usize; 2],
        /// Number of photographs of each model.
        sides: [usize; 2],
    },
    /// A part of the photographs stands still while the rest moves.
    StillRegion {
        /// Photographs of such pairs.
        photos: Vec<usize>,
        /// Number of such pairs, and of all pairs that were compared.
        pairs: [usize; 2],
        /// Median fraction of the matches that stand still.
        fraction: f64,
        /// Whether it has been masked.
        masked: bool,
    },
    /// Something moved between photographs.
    Moving {
        /// Photographs of such pairs.
        photos: Vec<usize>,
        /// Number of such pairs, and of all pairs that were compared.
        pairs: [usize; 2],
        /// Median number of matches on what moved.
        matches: usize,
    },
    /// Two photographs of the same part of the scene from the same place.
    Duplicate {
        /// The photographs.
        photos: [usize; 2],
    },
    /// Pairs that cannot all be right: repeated structures are mistaken for one.
    Contradiction {
        /// The pairs that contradict the rest, most matches first.
        pairs: Vec<[usize; 2]>,
        /// Matches of the first.
        matches: usize,
        /// The fraction of them that agrees with the rest.
        agreement: f64,
        /// Number of verified pairs whose photographs are in the model.
        total: usize,
    },
    /// Most pairs that show depth moved otherwise than in the model, which may fit only a plane.
    OtherMotion {
        /// These pairs.
        pairs: Vec<[usize; 2]>,
    },
    /// Photographs without a match to others from nearly the same place.
    Missing {
        /// The pair with the most points that should be matched.
        first: [usize; 2],
        /// The photographs of all such pairs, those in the most pairs first.
        photos: Vec<usize>,
        /// Number of points that should be matched in the first pair.
        expected: usize,
        /// Number of models of the parts that look alike; 1 if they are in one model.
        models: usize,
    },
    /// A photograph without a pose.
    LeftOut {
        /// The photograph.
        photo: usize,
        /// The reason.
        reason: String,
    },
}

impl Diagnosis {
    /// The family.
    pub fn kind(&self) -> Kind {
        match self {
            Diagnosis::Blurred { .. } => Kind::Blurred,
            Diagnosis::ExposureJump { .. } | Diagnosis::Clipped { .. } => Kind::Exposure,
            Diagnosis::FewFeatures { .. } => Kind::FewFeatures,
            Diagnosis::Hidden { .. } => Kind::Hidden,
            Diagnosis::Zoom { .. } | Diagnosis::OwnFocals { .. } | Diagnosis::ZoomSettings { .. } => Kind::Zoom,
            Diagnosis::Cropped { .. } => Kind::Cropped,
            Diagnosis::FocalUnknown { .. } => Kind::FocalUnknown,
            Diagnosis::SeparateParts { .. } => Kind::SeparateParts,
            Diagnosis::Bridge { .. } | Diagnosis::CutPoint { .. } => Kind::WeakLink,
            Diagnosis::FewPartners { .. } => Kind::FewPartners,
            Diagnosis::Gap { .. } => Kind::Gap,
            Diagnosis::OpenLoop { .. } => Kind::OpenLoop,
            Diagnosis::RotationOnly { .. } | Diagnosis::RotationBetweenModels { .. } => Kind::RotationOnly,
            Diagnosis::StillRegion { .. } => Kind::StillRegion,
            Diagnosis::Moving { .. } => Kind::Moving,
            Diagnosis::Duplicate { .. } => Kind::Duplicate,
            Diagnosis::Contradiction { .. } | Diagnosis::OtherMotion { .. } => Kind::Contradiction,
            Diagnosis::Missing { .. } => Kind::Missing,
            Diagnosis::LeftOut { .. } => Kind::LeftOut,
        }
    }

    /// The photographs at fault.
    pub fn photos(&self) -> Vec<usize> {
        match self {
            Diagnosis::Blurred { photo, .. }
            | Diagnosis::ExposureJump { photo, .. }
            | Diagnosis::Clipped { photo, .. }
            | Diagnosis::FewFeatures { photo, .. }
            | Diagnosis::Hidden { photo, .. }
            | Diagnosis::CutPoint { photo, .. }
            | Diagnosis::FewPartners { photo, .. }
            | Diagnosis::LeftOut { photo, .. } => vec![*photo],
            Diagnosis::Zoom { photos, .. }
            | Diagnosis::Cropped { photos, .. }
            | Diagnosis::FocalUnknown { photos }
            | Diagnosis::RotationOnly { photos, .. }
            | Diagnosis::StillRegion { photos, .. }
            | Diagnosis::Moving { photos, .. }
            | Diagnosis::Missing { photos, .. } => photos.clone(),
            Diagnosis::ZoomSettings { settings } => settings.iter().flat_map(|s| s.1.clone()).collect(),
            Diagnosis::SeparateParts { parts } => parts.iter().skip(1).flatten().copied().collect(),
            Diagnosis::Bridge { photos, .. } | Diagnosis::Duplicate { photos } => photos.to_vec(),
            Diagnosis::Gap { sides: ends, .. }
            | Diagnosis::OpenLoop { ends, .. }
            | Diagnosis::RotationBetweenModels { ends, .. }
            | Diagnosis::OwnFocals { ends, .. } => ends.to_vec(),
            Diagnosis::Contradiction { pairs, .. } | Diagnosis::OtherMotion { pairs } => {
                pairs.iter().flatten().copied().collect()
            }
        }
    }

    /// Two photographs, one of each side, that show what is wrong; the second is `None` where there is only one side.
    pub fn sides(&self) -> (usize, Option<usize>) {
        match self {
            Diagnosis::Blurred { photo, neighbours, .. } | Diagnosis::ExposureJump { photo, neighbours, .. } => {
                (*photo, neighbours.first().copied())
            }
            Diagnosis::CutPoint { photo, behind } => (*photo, behind.first().copied()),
            Diagnosis::FewPartners { photo, partners } => (*photo, partners.first().copied()),
            Diagnosis::SeparateParts { parts } => (parts[0][0], parts.get(1).map(|part| part[0])),
            Diagnosis::Missing { first: [a, b], .. } => (*a, Some(*b)),
            Diagnosis::ZoomSettings { settings } => (settings[0].1[0], settings.get(1).map(|other| other.1[0])),
            other => {
                let photos = other.photos();
                (photos.first().copied().unwrap_or(0), photos.get(1).copied())
            }
        }
    }

    /// The diagnosis as one sentence; `names` are those of all photographs.
    pub fn sentence<'a>(&'a self, names: &'a [String]) -> impl Display + 'a {
        Sentence { diagnosis: self, names }
    }
}

/// A diagnosis with the names of its photographs.
struct Sentence<'a> {
    diagnosis: &'a Diagnosis,
    names: &'a [String],
}

impl Sentence<'_> {
    /// `a.jpg, b.jpg, c.jpg and 12 others`
    fn list(&self, photos: &[usize]) -> String {
        const MAX_LISTED: usize = 4;
        let shown: Vec<&str> = photos
            .iter()
            .take(MAX_LISTED)
            .map(|p| self.names[*p].as_str())
            .collect();
        match photos.len() {
            0 => "none".into(),
            n if n <= MAX_LISTED => shown.join(", "),
            n if n == MAX_LISTED + 1 => format!("{} and 1 other", shown.join(", ")),
            n => format!("{} and {} others", shown.join(", "), n - MAX_LISTED),
        }
    }
}

impl Display for Sentence<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let name = |photo: &usize| self.names[*photo].as_str();
        let show = |photos: &[usize]| if photos.len() == 1 { "shows" } else { "show" };
        match self.diagnosis {
            Diagnosis::Blurred {
                photo,
                times,
                neighbours,
            } => write!(
                f,
                "{} is blurred: {times:.1} times less sharp than {}, which {} the same; take it again, or delete it",
                name(photo),
                self.list(neighbours),
                show(neighbours)
            ),
            Diagnosis::ExposureJump {
                photo,
                stops,
                neighbours,
            } => write!(
                f,
                "{} is {:.1} stops {} than {}, which {} the same; lock the exposure",
                name(photo),
                stops.abs(),
                if *stops > 0.0 { "brighter" } else { "darker" },
                self.list(neighbours),
                show(neighbours)
            ),
            Diagnosis::Clipped {
                photo,
                fraction,
                bright,
            } => write!(
                f,
                "{:.0} % of {} is {} without detail, far more than in the others; expose it like them",
                100.0 * fraction,
                name(photo),
                if *bright { "white" } else { "black" }
            ),
            Diagnosis::FewFeatures {
                photo,
                features,
                median,
            } => {
                write!(f, "{} has {features} features", name(photo))?;
                // Where most photographs have few features, there is nothing to compare with.
                if (*features as f64) < MIN_FEATURE_RATIO * *median as f64 {
                    write!(f, " where half of the photographs have {median} or more")?;
                }
                write!(f, ": it shows little texture; include something textured")
            }
            Diagnosis::Hidden { photo, fraction } => write!(
                f,
                "{:.0} % of {} is masked or transparent: white parts of a mask count, black ones are hidden",
                100.0 * fraction,
                name(photo)
            ),
            Diagnosis::Zoom { photos, ratio } => write!(
                f,
                "{} {} taken with {ratio:.2} times the focal length of the others; do not zoom",
                self.list(photos),
                if photos.len() == 1 { "was" } else { "were" }
            ),
            Diagnosis::OwnFocals {
                ends: [short, long],
                ratio,
            } => write!(
                f,
                "each photograph has its own focal length, which the metadata do not state ({} has {ratio:.2} times that of {}), and \
                 became its own camera; do not zoom, and use the photographs as the camera wrote them",
                name(long),
                name(short)
            ),
            Diagnosis::ZoomSettings { settings } => {
                let settings: Vec<String> = settings
                    .iter()
                    .map(|(focal, photos)| format!("{focal:.2} (as {})", name(&photos[0])))
                    .collect();
                write!(
                    f,
                    "the focal length differs between photographs: {} long sides; each setting needs enough photographs of its own",
                    settings.join(", ")
                )
            }
            Diagnosis::Cropped { photos, distance } => write!(
                f,
                "the principal point is up to {distance:.0} px off the centre of {}, as in photographs cropped from larger ones; use them \
                 as the camera took them",
                self.list(photos)
            ),
            Diagnosis::FocalUnknown { photos } => write!(
                f,
                "the focal length of {} is a guess: all values fit, as for a plane or for turns on the spot; take some from nearer, \
                 from farther away and from the side",
                self.list(photos)
            ),
            Diagnosis::SeparateParts { parts } => write!(
                f,
                "the photographs fall into {} parts without overlap, of {} photographs, such as {} and {}; take some between them",
                parts.len(),
                parts.iter().map(|p| p.len().to_string()).collect::<Vec<_>>().join(", "),
                name(&parts[0][0]),
                name(&parts[1][0])
            ),
            Diagnosis::Bridge { photos: [a, b], sides } => write!(
                f,
                "only {} and {} connect {} photographs with {} others; take more between them",
                name(a),
                name(b),
                sides[0],
                sides[1]
            ),
            Diagnosis::CutPoint { photo, behind } => write!(
                f,
                "only {} connects {} with the rest; take more around it",
                name(photo),
                self.list(behind)
            ),
            Diagnosis::FewPartners { photo, partners } => write!(
                f,
                "{} overlaps with {} other {}, fewer than 3; take more around it",
                name(photo),
                partners.len(),
                if partners.len() == 1 {
                    "photograph"
                } else {
                    "photographs"
                }
            ),
            Diagnosis::Gap { sides: [a, b], degrees } => write!(
                f,
                "there is a gap of {degrees:.0} degrees between {} and {}; take photographs there",
                name(a),
                name(b)
            ),
            Diagnosis::OpenLoop { ends: [a, b], degrees } => write!(
                f,
                "the loop around the scene is not closed: {} and {}, {degrees:.0} degrees apart, do not match; take photographs \
                 between them",
                name(a),
                name(b)
            ),
            Diagnosis::RotationOnly { photos, pairs } => write!(
                f,
                "{} were taken from one place ({pairs} pairs only turn); move sideways between photographs",
                self.list(photos)
            ),
            Diagnosis::RotationBetweenModels { ends: [a, b], sides } => write!(
                f,
                "between {} and {} the camera only turned, so the {} and {} photographs on either side are separate models; move \
                 sideways while turning there",
                self.names[*a], self.names[*b], sides[0], sides[1]
            ),
            Diagnosis::StillRegion {
                photos,
                pairs,
                fraction,
                masked,
            } => write!(
                f,
                "{:.0} % of the matches stand still while the rest moves, in {} of {} pairs, such as {}: {}a turntable in front of a \
                 fixed background, whatever carries the camera, or text laid over the photographs; {}",
                100.0 * fraction,
                pairs[0],
                pairs[1],
                self.list(photos),
                if *fraction >= MIN_STILL_CAMERA_FRACTION {
                    "a camera that did not move (walk around the scene with it), "
                } else {
                    ""
                },
                if *masked { "it is masked" } else { "mask it" }
            ),
            Diagnosis::Moving { photos, pairs, matches } => write!(
                f,
                "something moves: {matches} matches follow a motion of their own in {} of {} pairs, among {}; mask it, or poses may \
                 follow it",
                pairs[0],
                pairs[1],
                self.list(photos)
            ),
            Diagnosis::Duplicate { photos: [a, b] } => write!(
                f,
                "{} and {} show the same from the same place; delete one",
                name(a),
                name(b)
            ),
            Diagnosis::Contradiction {
                pairs,
                matches,
                agreement,
                total,
            } => write!(
                f,
                "{} of {total} pairs contradict the others, such as {} and {}, where {:.0} % of {matches} matches agree with them: parts \
                 that look alike may be mistaken for one another, and the model may be folded; include what tells them apart",
                pairs.len(),
                name(&pairs[0][0]),
                name(&pairs[0][1]),
                100.0 * agreement
            ),
            Diagnosis::OtherMotion { pairs } => write!(
                f,
                "most pairs that show depth ({}, such as {} and {}) moved otherwise than in the model: it may fit only a plane, such as \
                 the ground, and what stands on it would be blurred; take photographs nearer to what stands out, and from the side",
                pairs.len(),
                name(&pairs[0][0]),
                name(&pairs[0][1])
            ),
            Diagnosis::Missing {
                first: [a, b],
                photos,
                expected,
                models: 1,
            } => write!(
                f,
                "{} photographs share nothing with others from nearly the same place, such as {} and {}, which should have {expected} \
                 points in common: either parts that look alike are mistaken for one and the model is folded, or an object was moved \
                 between the photographs; pose them separately, or mask what stayed in place",
                photos.len(),
                name(a),
                name(b)
            ),
            Diagnosis::Missing {
                first: [a, b],
                photos,
                expected,
                models,
            } => write!(
                f,
                "{} photographs, such as {} and {}, were posed at nearly the same place but share nothing, although they should have \
                 {expected} points in common: parts that look alike are now {models} models; take photographs that lead from one to \
                 the other",
                photos.len(),
                name(a),
                name(b)
            ),
            Diagnosis::LeftOut { photo, reason } => write!(f, "{} is left out: {reason}", name(photo)),
        }
    }
}
