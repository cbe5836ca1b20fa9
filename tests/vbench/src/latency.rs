//! Delays between actions on a device and their effects, and between one event and the next.
//!
//! Invariant: an effect counts for a cause only before the next cause; missing effects are counted, not left out.

use std::fmt;

/// Delays of one kind, ms.
#[derive(Clone, Debug, Default)]
pub struct Delays {
    found: Vec<f64>,
    missing: usize,
}

impl Delays {
    /// For each cause the first effect at or after it, before the next cause. Times in ns on one clock; effects sorted.
    pub fn between(causes: &[u64], effects: &[u64]) -> Self {
        let mut delays = Self::default();
        for (place, cause) in causes.iter().enumerate() {
            let end = causes.get(place + 1).copied().unwrap_or(u64::MAX);
            match effects.iter().find(|effect| (*cause..end).contains(effect)) {
                Some(effect) => delays.found.push((effect - cause) as f64 / 1e6),
                None => delays.missing += 1,
            }
        }
        delays.found.sort_by(f64::total_cmp);
        delays
    }

    /// The first effect of each cause, as in [`Self::between`], as time from the cause's own `moment`; negative if the
    /// effect came first. This compares two listeners to one event, neither of which always receives it first.
    pub fn beside(causes: &[u64], moments: &[u64], effects: &[u64]) -> Self {
        let (mut found, mut missing) = (Vec::new(), 0);
        for (place, (cause, moment)) in causes.iter().zip(moments).enumerate() {
            let end = causes.get(place + 1).copied().unwrap_or(u64::MAX);
            match effects.iter().find(|effect| (*cause..end).contains(effect)) {
                Some(effect) => found.push((*effect as f64 - *moment as f64) / 1e6),
                None => missing += 1,
            }
        }
        Self { missing, ..Self::of(found) }
    }

    /// Delays given in ms.
    pub fn of(mut found: Vec<f64>) -> Self {
        found.sort_by(f64::total_cmp);
        Self { found, missing: 0 }
    }

    /// The time from each of these moments to the next; ns on one clock, sorted.
    pub fn apart(moments: &[u64]) -> Self {
        let gaps = moments.iter().zip(moments.iter().skip(1)).map(|(one, next)| one.abs_diff(*next));
        Self::of(gaps.map(|gap| gap as f64 / 1e6).collect())
    }

    /// How many effects arrived, of how many: `n=19/20`.
    pub fn count(&self) -> String {
        format!("n={}/{}", self.found.len(), self.found.len() + self.missing)
    }

    /// The value that this share of the delays does not exceed (nearest rank).
    pub fn quantile(&self, share: f64) -> Option<f64> {
        let rank = (share * self.found.len() as f64).ceil() as usize;
        self.found.get(rank.max(1) - 1).copied()
    }
}

impl fmt::Display for Delays {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.count())?;
        for (name, share) in [("min", 0.0), ("p50", 0.5), ("p95", 0.95), ("max", 1.0)] {
            if let Some(value) = self.quantile(share) {
                write!(f, " {name}={value:.1}")?;
            }
        }
        f.write_str(" ms")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn effects_belong_to_the_cause_before_them() {
        let ms = |all: &[u64]| all.iter().map(|value| value * 1_000_000).collect::<Vec<_>>();
        let delays = Delays::between(&ms(&[100, 200, 300]), &ms(&[50, 130, 140, 310]));
        assert_eq!(delays.to_string(), "n=2/3 min=10.0 p50=10.0 p95=30.0 max=30.0 ms");
        assert_eq!(Delays::between(&[], &[]).to_string(), "n=0/0 ms");
    }

    #[test]
    fn an_effect_may_come_before_another_listener_receives_the_cause() {
        let ms = |all: &[u64]| all.iter().map(|value| value * 1_000_000).collect::<Vec<_>>();
        let delays = Delays::beside(&ms(&[100, 200, 300]), &ms(&[110, 210, 310]), &ms(&[108, 213]));
        assert_eq!(delays.to_string(), "n=2/3 min=-2.0 p50=-2.0 p95=3.0 max=3.0 ms");
    }

    #[test]
    fn moments_have_one_gap_fewer_than_their_number() {
        let gaps = Delays::apart(&[1_000_000, 3_000_000, 4_000_000, 9_000_000]);
        assert_eq!(gaps.to_string(), "n=3/3 min=1.0 p50=2.0 p95=5.0 max=5.0 ms");
        assert_eq!(Delays::apart(&[7]).to_string(), "n=0/0 ms");
    }
}
