//! The pattern of flashes by which the latency of a camera is measured.
//!
//! Dark and lit alternate, for pseudo-random times that never change: a camera's recording fits the
//! pattern at one delay only. The beginning of the pattern is all that the display and the
//! evaluation need to share.
//!
//! Invariant: a pure function of time.
//! Invariant: never more than three flashes a second, the limit below which light is not known to
//! cause seizures (WCAG 2.2, criterion 2.3.1); a flash is two changes.

use std::time::Duration;

/// Dark before the first change, for the camera to adapt.
const DARK: Duration = Duration::from_secs(1);
/// Least time between two changes.
const SHORTEST: Duration = Duration::from_millis(200);
/// How much longer it may be, in ms.
const SPREAD: u64 = 300;

/// A change of the light.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Change {
    /// When, after the beginning of the pattern.
    pub after: Duration,
    /// Lit from then on, or dark.
    pub lit: bool,
}

/// All changes, in the order of time, endless. Before the first it is dark.
pub fn changes() -> impl Iterator<Item = Change> {
    let mut after = DARK;
    (0_u64..).map(move |index| {
        let change = Change { after, lit: index.is_multiple_of(2) };
        after += SHORTEST + Duration::from_millis(mixed(index) % SPREAD);
        change
    })
}

/// The share of the time from `from` to `to`, both after the beginning, in which it is lit.
#[cfg(test)]
pub(crate) fn lit_share(from: Duration, to: Duration) -> f64 {
    let Some(span) = to.checked_sub(from).filter(|span| !span.is_zero()) else { return 0.0 };
    let mut lit = Duration::ZERO;
    let mut since = None;
    for change in changes() {
        let at = change.after.clamp(from, to);
        match since.replace(at) {
            Some(began) if !change.lit => lit += at.saturating_sub(began),
            _ => {}
        }
        if change.after >= to {
            break;
        }
    }
    lit.as_secs_f64() / span.as_secs_f64()
}

/// `SplitMix64` (Steele, Lea, Flood: Fast splittable pseudorandom number generators, 2014).
const fn mixed(index: u64) -> u64 {
    let mut z = index.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_second_has_more_than_three_flashes() {
        let times: Vec<_> = changes().take(20_000).map(|change| change.after).collect();
        for second in times.windows(7) {
            assert!(second[6] > second[0] + Duration::from_secs(1), "{second:?}");
        }
    }

    #[test]
    fn the_share_is_the_integral_of_the_pattern() {
        let first: Vec<_> = changes().take(3).collect();
        assert_eq!((first[0].after, first[0].lit, first[1].lit), (DARK, true, false));
        let (on, off) = (first[0].after, first[1].after);
        let ms = Duration::from_millis;
        let earlier = |at: Duration| at.saturating_sub(ms(10));
        assert!(lit_share(ms(0), on).abs() < 1e-12 && (lit_share(on, off) - 1.0).abs() < 1e-12);
        assert!((lit_share(earlier(on), on + ms(30)) - 0.75).abs() < 1e-9);
        assert!((lit_share(earlier(off), off + ms(30)) - 0.25).abs() < 1e-9);
        assert!(lit_share(on, on).abs() < 1e-12);
        // In steps of a millisecond, over a minute.
        let mut lit = false;
        let mut next = changes().peekable();
        for at in 0..60_000 {
            while let Some(change) = next.next_if(|change| change.after <= ms(at)) {
                lit = change.lit;
            }
            assert!((lit_share(ms(at), ms(at + 1)) - f64::from(u8::from(lit))).abs() < 1e-9, "{at}");
        }
    }
}
