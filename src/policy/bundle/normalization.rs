//! Checks how values are normalised.

use rapid_core::text::counted;
use serde_json::Value;

use super::read::{Problems, read_tagged};
use super::spec::Normalization;

/// Reports a list that has not one number for each of `len` dimensions.
pub(super) fn check_length(entry: &str, numbers: &[f32], len: usize, problems: &mut Problems) -> bool {
    if numbers.len() != len {
        let [found, len] = [(numbers.len(), "value"), (len, "dimension")].map(|(count, of)| counted(count as u64, of));
        problems.wrong(entry, format!("has {found} for {len}"));
    }
    numbers.len() == len
}

/// A normalisation of `len` dimensions, if that is known.
pub(super) fn normalization(
    entry: &str,
    value: &Value,
    len: Option<usize>,
    problems: &mut Problems,
) -> Option<Normalization> {
    let found = read_tagged(entry, "mode", value, problems)?;
    let place = |name: &str| format!("{entry}.{name}");
    let fits = |name: &str, numbers: &[f32], problems: &mut Problems| {
        len.is_none_or(|len| check_length(&place(name), numbers, len, problems))
    };
    match &found {
        Normalization::MinMax { min, max } => {
            if !(fits("min", min, problems) & fits("max", max, problems)) {
                return None;
            }
            for (at, (min, max)) in min.iter().zip(max).enumerate() {
                let place = place(&format!("max[{at}]"));
                if max <= min {
                    problems.wrong(&place, format!("{max} is not above min[{at}] = {min}"));
                } else if !(max - min).is_finite() {
                    problems.wrong(&place, format!("is too far from min[{at}] for a 32-bit float"));
                }
            }
        }
        Normalization::MeanStd { mean, std, eps } => {
            if !(fits("mean", mean, problems) & fits("std", std, problems)) {
                return None;
            }
            if !(0.0..=1.0).contains(eps) {
                problems.wrong(&place("eps"), format!("{eps} is not between 0 and 1"));
                return None;
            }
            for (at, std) in std.iter().enumerate() {
                let place = place(&format!("std[{at}]"));
                if *std < 0.0 {
                    problems.wrong(&place, format!("{std} is below 0"));
                } else if std + eps <= 0.0 {
                    problems.wrong(&place, "both this value and eps are 0: the statistics would be divided by 0");
                }
            }
        }
        Normalization::Identity => {}
    }
    Some(found)
}
