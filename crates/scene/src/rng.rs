//! The project's random number generator: small and seedable, with a state of two words, which a checkpoint can store.

/// PCG-XSH-RR 64/32 (O'Neill 2014).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rng {
    /// Current state.
    pub state: u64,
    /// Stream selector, odd.
    pub stream: u64,
}

impl Rng {
    /// A generator from `seed` on `stream`; streams of the same seed are independent.
    pub fn new(seed: u64, stream: u64) -> Self {
        let mut rng = Self {
            state: 0,
            stream: (stream << 1) | 1,
        };
        rng.next_u32();
        rng.state = rng.state.wrapping_add(seed);
        rng.next_u32();
        rng
    }

    /// 32 uniform bits.
    pub fn next_u32(&mut self) -> u32 {
        let old = self.state;
        self.state = old.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(self.stream);
        let xorshifted = (((old >> 18) ^ old) >> 27) as u32;
        xorshifted.rotate_right((old >> 59) as u32)
    }

    /// Skips `count` draws of 32 bits in logarithmic time (Brown 1994), so that threads can start in the middle of one sequence.
    pub fn advance(&mut self, mut count: u64) {
        let (mut factor, mut summand) = (6_364_136_223_846_793_005u64, self.stream);
        let (mut total_factor, mut total_summand) = (1u64, 0u64);
        while count > 0 {
            if count & 1 == 1 {
                total_factor = total_factor.wrapping_mul(factor);
                total_summand = total_summand.wrapping_mul(factor).wrapping_add(summand);
            }
            summand = factor.wrapping_add(1).wrapping_mul(summand);
            factor = factor.wrapping_mul(factor);
            count >>= 1;
        }
        self.state = total_factor.wrapping_mul(self.state).wrapping_add(total_summand);
    }

    /// Uniform in \[0, 1), 24 bits.
    pub fn uniform(&mut self) -> f32 {
        (self.next_u32() >> 8) as f32 * (1.0 / 16_777_216.0)
    }

    /// Uniform in \[low, high).
    pub fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.uniform()
    }

    /// Uniform integer below `n` (n > 0), without bias (Lemire 2019).
    pub fn below(&mut self, n: u32) -> u32 {
        let threshold = n.wrapping_neg() % n;
        loop {
            let product = u64::from(self.next_u32()) * u64::from(n);
            if (product as u32) >= threshold {
                return (product >> 32) as u32;
            }
        }
    }

    /// Standard normal variate (Box and Muller 1958).
    pub fn normal(&mut self) -> f32 {
        let u = (f64::from(self.next_u32()) + 1.0) / 4_294_967_297.0;
        let v = f64::from(self.next_u32()) / 4_294_967_296.0;
        ((-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()) as f32
    }

    /// Shuffles `items` in place (Fisher-Yates).
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            items.swap(i, self.below(i as u32 + 1) as usize);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_differ_and_normal_moments_match() {
        let (mut a, mut b) = (Rng::new(7, 0), Rng::new(7, 1));
        assert_ne!(a.next_u32(), b.next_u32());
        let n = 100_000;
        let (mut sum, mut squares) = (0.0f64, 0.0f64);
        for _ in 0..n {
            let x = f64::from(a.normal());
            sum += x;
            squares += x * x;
        }
        // Standard errors at n = 1e5: 0.0032 for the mean, 0.0045 for the variance; five of them.
        assert!((sum / f64::from(n)).abs() < 0.016);
        assert!((squares / f64::from(n) - 1.0).abs() < 0.023);
    }

    #[test]
    fn advancing_skips_as_many_draws() {
        for count in [0, 1, 2, 77, 4096] {
            let (mut a, mut b) = (Rng::new(3, 9), Rng::new(3, 9));
            (0..count).for_each(|_| {
                a.next_u32();
            });
            b.advance(count);
            assert_eq!(a, b);
        }
    }

    #[test]
    fn shuffle_is_a_permutation() {
        let mut items: Vec<u32> = (0..100).collect();
        Rng::new(1, 2).shuffle(&mut items);
        assert_ne!(items, (0..100).collect::<Vec<_>>());
        items.sort_unstable();
        assert_eq!(items, (0..100).collect::<Vec<_>>());
    }
}
