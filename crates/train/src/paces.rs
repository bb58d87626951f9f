//! The pace of each step of a run. With a budget it depends on the wall clock, and so do all results of training.

/// Paces in the order of steps: each holds from its step until the next pair; a first pair of step 0 has the recipe steps that were skipped
/// instead. A run that repeats them writes the same bytes as the original run, independent of the clock.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Paces(Vec<(u64, f64)>);

impl Paces {
    /// Parses lines of `step pace`, where step is the first (from 1) with that pace; a first line of step 0 has the recipe steps skipped
    /// before. Text after the last newline is a truncated line and is ignored.
    ///
    /// # Errors
    /// One line with the number of the first invalid line, or saying that the steps do not ascend from 1, as when there are no lines.
    pub fn parse(text: &str) -> Result<Self, String> {
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        let pair = |(number, line): (usize, &str)| {
            let pair = line.split_once(' ').and_then(|(step, pace)| {
                let pace: f64 = pace.parse().ok()?;
                Some((step.parse().ok()?, pace)).filter(|_| pace > 0.0 && pace.is_finite())
            });
            pair.ok_or_else(|| format!("line {} is not a step and a pace", number + 1))
        };
        let pairs: Vec<(u64, f64)> = whole.lines().enumerate().map(pair).collect::<Result<_, _>>()?;
        let ascend = pairs.windows(2).all(|pair| pair[0].0 < pair[1].0);
        match pairs.iter().find(|(step, _)| *step > 0) {
            Some((1, _)) if ascend => Ok(Self(pairs)),
            _ => Err("its steps do not ascend from 1".into()),
        }
    }

    /// The line of a step whose pace differs from the previous one. The pace is written such that it parses to the same bits.
    pub fn line(step: u64, pace: f64) -> String {
        format!("{step} {pace}\n")
    }

    /// All lines.
    pub fn to_text(&self) -> String {
        self.0.iter().map(|(step, pace)| Self::line(*step, *pace)).collect()
    }

    /// The pace of `step`, counted from 1; after the last pair, the pace of that pair.
    pub(crate) fn at(&self, step: u64) -> Option<f64> {
        let next = self.0.partition_point(|(first, _)| *first <= step);
        Some(self.0[next.checked_sub(1)?].1)
    }

    /// The recipe steps skipped before the first step.
    pub(crate) fn skipped(&self) -> f64 {
        self.0
            .first()
            .filter(|(step, _)| *step == 0)
            .map_or(0.0, |(_, skipped)| *skipped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paces_round_trip_bit_for_bit_and_hold_until_the_next() {
        let (third, tiny) = (1.0 / 3.0, f64::MIN_POSITIVE);
        let text = Paces::line(1, third) + &Paces::line(4, tiny) + &Paces::line(9, 1e300) + "12 0.5";
        let paces = Paces::parse(&text).unwrap();
        assert_eq!(Paces::parse(&paces.to_text()).as_ref(), Ok(&paces));
        let at = [1, 3, 4, 8, 9, 5000].map(|step| paces.at(step).unwrap());
        assert_eq!(at, [third, third, tiny, tiny, 1e300, 1e300]);
        assert_eq!(paces.skipped(), 0.0);
        let late = Paces::parse("0 2700.5\n1 0.5\n").unwrap();
        assert_eq!((late.skipped(), late.at(1)), (2700.5, Some(0.5)));
        assert_eq!(Paces::parse(&late.to_text()), Ok(late));
        for wrong in [
            "",
            "1 0.5",
            "2 0.5\n",
            "0 7\n",
            "0 7\n2 0.5\n",
            "1 0.5\n1 0.6\n",
            "1 0.5\nx\n",
            "1 -1\n",
            "1 NaN\n",
        ] {
            assert!(Paces::parse(wrong).is_err(), "{wrong:?}");
        }
    }
}
