//! Values as they are typed, and what is said of those that are none.

use std::time::Duration;

use crate::lockstep::evaluate::Condition;

pub(super) fn duration(text: &str) -> Result<Duration, String> {
    match humantime::parse_duration(text) {
        Ok(Duration::ZERO) => Err("must be longer than nothing".to_owned()),
        Ok(duration) => Ok(duration),
        Err(_) => Err("write a number and a unit, for example 30s, 500ms or 2m".to_owned()),
    }
}

pub(super) fn flashing(text: &str) -> Result<Duration, String> {
    match duration(text)? {
        length if (Duration::from_secs(5)..=Duration::from_mins(10)).contains(&length) => Ok(length),
        _ => Err("must lie between 5s and 10m".to_owned()),
    }
}

pub(super) fn light_delay(text: &str) -> Result<Duration, String> {
    match humantime::parse_duration(text) {
        Ok(delay) if delay <= Duration::from_secs(1) => Ok(delay),
        Ok(_) => Err("must be 1s at most".to_owned()),
        Err(_) => Err("write a number and a unit, for example 15ms".to_owned()),
    }
}

pub(super) fn window(text: &str) -> Result<Duration, String> {
    match humantime::parse_duration(text) {
        Ok(window) if (Duration::from_millis(1)..=Duration::from_secs(10)).contains(&window) => Ok(window),
        Ok(_) => Err("must lie between 1ms and 10s".to_owned()),
        Err(_) => Err("write a number and a unit, for example 25ms".to_owned()),
    }
}

pub(super) fn rate(text: &str) -> Result<f64, String> {
    let hertz: f64 = text.parse().map_err(|_| "write a number, for example 30".to_owned())?;
    if (0.1..=1000.0).contains(&hertz) { Ok(hertz) } else { Err("must lie between 0.1 and 1000 Hz".to_owned()) }
}

pub(super) fn condition(text: &str) -> Result<Condition, String> {
    let known = Condition::ALL.into_iter().find(|condition| condition.word() == text);
    known.ok_or_else(|| format!("one of {}", Condition::ALL.map(Condition::word).join(", ")))
}

pub(super) fn tag(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((key, value)) if !key.is_empty() => Ok((key.to_owned(), value.to_owned())),
        _ => Err("write KEY=VALUE, for example finger=soft".to_owned()),
    }
}

pub(super) fn instance(text: &str) -> Result<String, String> {
    let plain = !text.is_empty() && text.len() <= 32 && text.chars().all(|c| c.is_ascii_alphanumeric() || c == '-');
    if plain { Ok(text.to_owned()) } else { Err("1 to 32 letters, digits and dashes".to_owned()) }
}
