//! Durations and sizes as people write them: a number and a unit.
//!
//! Invariant: one grammar of durations, in registries, scenarios, journals and on the command line, with the units of the
//! crate humantime: a month is 30.44 days, a year 365.25.
//! What is shown can be read again, and is the same.

use std::time::Duration;

const DURATIONS: [(&[&str], u128); 10] = [
    (&["ns", "nsec", "nanos"], 1),
    (&["us", "µs", "usec"], 1_000),
    (&["ms", "msec", "millis"], 1_000_000),
    (&["s", "sec", "secs", "second", "seconds"], SECOND),
    (&["m", "min", "mins", "minute", "minutes"], 60 * SECOND),
    (&["h", "hr", "hrs", "hour", "hours"], 3_600 * SECOND),
    (&["d", "day", "days"], 86_400 * SECOND),
    (&["w", "wk", "wks", "week", "weeks"], 604_800 * SECOND),
    (&["M", "month", "months"], 2_630_016 * SECOND),
    (&["y", "yr", "yrs", "year", "years"], 31_557_600 * SECOND),
];
const SECOND: u128 = 1_000_000_000;

const SIZES: [(&str, u64); 9] = [
    ("B", 1),
    ("kB", 1_000),
    ("MB", 1_000_000),
    ("GB", 1_000_000_000),
    ("TB", 1_000_000_000_000),
    ("KiB", 1 << 10),
    ("MiB", 1 << 20),
    ("GiB", 1 << 30),
    ("TiB", 1 << 40),
];

/// `25ms`, `1.5s`, `2 min`, `1h 30min`: numbers, whole or decimal, each with its unit, from `ns` to years; only `0` needs
/// no unit. Each is rounded to whole ns. `None` when the text is not a duration, or longer than 2^64 ns (584 years).
pub fn parse_duration(text: &str) -> Option<Duration> {
    let total = terms(text).try_fold(0_u128, |sum, term| sum.checked_add(nanoseconds(term)?))?;
    u64::try_from(total).ok().map(Duration::from_nanos)
}

/// A number and its unit, in ns. What is behind the point may be any number of digits, and before it none: episodes carry
/// registries with `.5s` and `16.6666667ms`, which humantime refuses, and it reads `1 5s` as 15 s.
fn nanoseconds(term: &str) -> Option<u128> {
    /// Digits behind the point that count: of a year the last is less than a ns.
    const DIGITS: usize = 18;
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let (number, unit) = term.split_at(term.find(char::is_alphabetic).unwrap_or(term.len()));
    let (number, unit) = (number.trim(), unit.trim());
    if (number, unit) == ("0", "") {
        return Some(0);
    }
    let (whole, fraction) = match number.split_once('.') {
        Some(("", fraction)) => ("0", fraction),
        Some(parts) => parts,
        None => (number, "0"),
    };
    if !is_number(whole) || !is_number(fraction) {
        return None;
    }
    let (_, unit) = DURATIONS.into_iter().find(|(names, _)| names.contains(&unit))?;
    let part = fraction.get(..DIGITS).unwrap_or(fraction).parse::<u128>().ok()? * unit;
    let scale = 10_u128.pow(u32::try_from(fraction.len().min(DIGITS)).ok()?);
    let part = (part + scale / 2) / scale;
    whole.parse::<u128>().ok()?.checked_mul(unit)?.checked_add(part)
}

/// The numbers of a text, each with what follows it up to the next number; at least one.
fn terms(text: &str) -> impl Iterator<Item = &str> {
    let mut rest = Some(text.trim());
    std::iter::from_fn(move || {
        let all = rest.take()?;
        let unit = all.find(char::is_alphabetic).unwrap_or(all.len());
        let end = all[unit..].find(|c: char| c.is_ascii_digit() || c == '.').map(|at| unit + at);
        let (term, others) = end.map_or((all, None), |end| (&all[..end], Some(&all[end..])));
        rest = others;
        Some(term)
    })
}

/// `512MiB`, `64 KiB`, `2MB`. `None` without a unit, or when it is not a size.
pub fn parse_size(text: &str) -> Option<u64> {
    let (number, unit) = split(text)?;
    let (_, bytes) = SIZES.into_iter().find(|(name, _)| name.eq_ignore_ascii_case(unit))?;
    let total = (number * bytes as f64).round();
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "checked to be within 0..=2^60")]
    (0.0..=1_152_921_504_606_846_976.0).contains(&total).then_some(total as u64)
}

fn split(text: &str) -> Option<(f64, &str)> {
    let text = text.trim();
    let end = text.find(|c: char| !(c.is_ascii_digit() || c == '.'))?;
    let (number, unit) = text.split_at(end);
    Some((number.parse().ok()?, unit.trim_start()))
}

/// A duration in its largest whole unit.
pub fn show_duration(duration: Duration) -> String {
    let nanoseconds = duration.as_nanos();
    for (unit, in_ns) in
        [("h", 3_600_000_000_000), ("min", 60_000_000_000), ("s", 1_000_000_000), ("ms", 1_000_000), ("us", 1_000)]
    {
        if nanoseconds >= in_ns && nanoseconds.is_multiple_of(in_ns) {
            return format!("{}{unit}", nanoseconds / in_ns);
        }
    }
    if nanoseconds == 0 { "0s".to_owned() } else { format!("{nanoseconds}ns") }
}

/// A size in the largest binary unit in which it is at least one, to one decimal.
pub fn show_size(bytes: u64) -> String {
    for (unit, shift) in [("TiB", 40), ("GiB", 30), ("MiB", 20), ("KiB", 10)] {
        let one = 1_u64 << shift;
        if bytes >= one {
            let whole = bytes.is_multiple_of(one);
            return if whole {
                format!("{}{unit}", bytes / one)
            } else {
                format!("{:.1}{unit}", bytes as f64 / one as f64)
            };
        }
    }
    format!("{bytes}B")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_need_a_number_and_a_unit() {
        for (text, expected) in [
            ("25ms", Some(Duration::from_millis(25))),
            ("1.5s", Some(Duration::from_millis(1500))),
            ("2 min", Some(Duration::from_mins(2))),
            ("0s", Some(Duration::ZERO)),
            ("250us", Some(Duration::from_micros(250))),
            ("0.5 ms", Some(Duration::from_micros(500))),
            (" 0.000000001s ", Some(Duration::from_nanos(1))),
            ("1h 30min", Some(Duration::from_mins(90))),
            ("1h30m0.5s", Some(Duration::from_millis(5_400_500))),
            ("7d", Some(Duration::from_hours(168))),
            ("0", Some(Duration::ZERO)),
            ("18446744073709551615ns", Some(Duration::from_nanos(u64::MAX))),
            ("18446744073709551616ns", None),
            ("18446744073709551615ns 1ns", None),
            ("584years 10months", None),
            ("18446744073709551615s 1000ms", None),
            ("0.5ns", Some(Duration::from_nanos(1))),
            ("0.49ns", Some(Duration::ZERO)),
            (".5s", Some(Duration::from_millis(500))),
            ("1s .5ms", Some(Duration::from_secs(1) + Duration::from_micros(500))),
            ("16.6666667ms", Some(Duration::from_nanos(16_666_667))),
            ("0.3333333333333333333333333333333333333333333s", Some(Duration::from_nanos(333_333_333))),
            ("0.0001h", Some(Duration::from_millis(360))),
            ("1.5y", Some(Duration::from_hours(13_149))),
            ("1 month", Some(Duration::from_secs(2_630_016))),
            ("1M", Some(Duration::from_secs(2_630_016))),
            ("1m", Some(Duration::from_mins(1))),
            ("2 weeks 1 day", Some(Duration::from_hours(360))),
            ("5µs", Some(Duration::from_micros(5))),
            ("5S", None),
            ("1 5s", None),
            ("1. 5s", None),
            ("1.5 5s", None),
            ("1.s", None),
            (".s", None),
            ("1.5.5s", None),
            ("25", None),
            ("1h 30", None),
            ("", None),
            (" ", None),
            ("ms", None),
            ("-5ms", None),
            ("5ms -1ms", None),
            ("1..5s", None),
            ("5 lightyears", None),
            ("5 ms s", None),
            ("999999999999999999h", None),
            ("1e3s", None),
            ("NaN s", None),
            ("NaN", None),
            ("inf s", None),
            ("\u{0661}s", None),
        ] {
            assert_eq!(parse_duration(text), expected, "{text:?}");
        }
    }

    #[test]
    fn sizes_need_a_number_and_a_unit() {
        for (text, expected) in [
            ("512MiB", Some(512 << 20)),
            ("64 kib", Some(64 << 10)),
            ("2MB", Some(2_000_000)),
            ("1.5GiB", Some(3 << 29)),
            ("4096B", Some(4096)),
            ("1TiB", Some(1 << 40)),
            ("0.5TB", Some(500_000_000_000)),
            ("4096", None),
            ("MiB", None),
            ("99999999999999GiB", None),
        ] {
            assert_eq!(parse_size(text), expected, "{text:?}");
        }
    }

    #[test]
    fn formatted_units_can_be_parsed_again() {
        for ns in [0, 1, 1_500, 25_000_000, 2_500_000_000, 90_000_000_000, 3_600_000_000_000, u64::MAX - 15, u64::MAX] {
            let duration = Duration::from_nanos(ns);
            assert_eq!(parse_duration(&show_duration(duration)), Some(duration));
        }
        assert_eq!(show_size(512 << 20), "512MiB");
        assert_eq!(show_size(614_400), "600KiB");
        assert_eq!((show_size(1 << 40), show_size(0)), ("1TiB".to_owned(), "0B".to_owned()));
        assert_eq!(show_size(1_500_000), "1.4MiB");
    }
}
