use rayon::prelude::*;

/// A set of splats of a scene: one flag per splat.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Selection(Vec<bool>);

impl Selection {
    /// Selects none of `n` splats.
    pub fn none(n: usize) -> Self {
        Self(vec![false; n])
    }

    /// Selects all of `n` splats.
    pub fn all(n: usize) -> Self {
        Self(vec![true; n])
    }

    /// Selects those of `n` splats for which `is_in` is true.
    pub fn of(n: usize, is_in: impl Fn(usize) -> bool + Sync + Send) -> Self {
        Self((0..n).into_par_iter().with_min_len(1024).map(is_in).collect())
    }

    /// Number of splats, selected or not.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether no splat is selected.
    pub fn is_empty(&self) -> bool {
        !self.0.contains(&true)
    }

    /// Number of selected splats.
    pub fn count(&self) -> usize {
        self.0.iter().filter(|selected| **selected).count()
    }

    /// Whether splat `i` is selected.
    pub fn contains(&self, i: usize) -> bool {
        self.0[i]
    }

    /// One flag per splat.
    pub fn as_slice(&self) -> &[bool] {
        &self.0
    }

    /// The selected splats, ascending.
    pub fn indices(&self) -> Vec<u32> {
        (0..self.len() as u32).filter(|i| self.0[*i as usize]).collect()
    }

    /// Selects or deselects splat `i`.
    pub fn set(&mut self, i: usize, selected: bool) {
        self.0[i] = selected;
    }

    /// Adds the splats of `other`.
    pub fn add(&mut self, other: &Self) {
        self.combine(other, |a, b| a | b);
    }

    /// Removes the splats of `other`.
    pub fn subtract(&mut self, other: &Self) {
        self.combine(other, |a, b| a & !b);
    }

    /// Keeps only the splats that are also in `other`.
    pub fn intersect(&mut self, other: &Self) {
        self.combine(other, |a, b| a & b);
    }

    /// Selects exactly the splats that were not selected.
    pub fn invert(&mut self) {
        self.0.iter_mut().for_each(|selected| *selected = !*selected);
    }

    fn combine(&mut self, other: &Self, with: impl Fn(bool, bool) -> bool) {
        assert_eq!(self.len(), other.len(), "selections of the same scene");
        for (a, b) in self.0.iter_mut().zip(&other.0) {
            *a = with(*a, *b);
        }
    }

    /// Appends `n` splats that are not selected.
    pub(crate) fn append(&mut self, n: usize) {
        self.0.resize(self.len() + n, false);
    }

    /// The flags of the splats `indices`, in that order.
    pub(crate) fn gather(&self, indices: &[u32]) -> Self {
        Self(indices.iter().map(|i| self.0[*i as usize]).collect())
    }
}
