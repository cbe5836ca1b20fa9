//! How a motor starts, when what it does is a fault, and how it stops.

use std::time::Duration;

use super::above_zero;
use crate::registry::parse::interlock::{LEVELS, gpio_line};
use crate::registry::section::{Problems, Section};
use crate::registry::spec::{BrakeSpec, MotionSpec, MotorMode, Stop, StopSpec, WatchSpec};

/// What a brake looks like.
const BRAKE: &str = "brake = { chip = \"/dev/gpiochip0\", line = 4, released = \"high\" }";
/// A small spring-applied brake takes this long to engage or to release, unless its data sheet says otherwise.
const BRAKE_TIME: Duration = Duration::from_millis(100);

/// How the command of a position starts and changes.
pub(super) fn motion(
    entry: &Section<'_>,
    slew: f64,
    mode: Option<MotorMode>,
    problems: &mut Problems<'_>,
) -> MotionSpec {
    let default = MotionSpec::of_slew(slew);
    if mode == Some(MotorMode::Velocity) {
        for key in ["acceleration", "soft_start", "first_target"].into_iter().filter(|key| entry.has(key)) {
            let message = format!("a commanded velocity has no {key}");
            entry.report(problems, key, message, format!("remove {key}; slew limits its acceleration"));
        }
        return default;
    }
    let soft_start = entry.duration(problems, "soft_start", Duration::ZERO..=Duration::from_secs(10));
    MotionSpec {
        acceleration: above_zero(entry, "acceleration", 100_000.0, problems).unwrap_or(default.acceleration),
        soft_start: soft_start.unwrap_or(default.soft_start),
        first_target: above_zero(entry, "first_target", 200.0, problems).unwrap_or(default.first_target),
    }
}

/// When what the motor does is a fault.
pub(super) fn watch(entry: &Section<'_>, problems: &mut Problems<'_>) -> WatchSpec {
    let default = WatchSpec::default();
    let half_a_second = Duration::from_millis(500);
    WatchSpec {
        margin: entry.number(problems, "margin", 0.0..=1.0).unwrap_or(default.margin),
        lag: above_zero(entry, "lag", 10.0, problems).unwrap_or(default.lag),
        blocked_after: or_never(entry, problems, "blocked_after", half_a_second, default.blocked_after),
    }
}

/// How the motor stops at a fault, or at an emergency stop.
pub(super) fn stop(entry: &Section<'_>, mode: Option<MotorMode>, problems: &mut Problems<'_>) -> StopSpec {
    let has_damping = mode.is_none_or(|mode| matches!(mode, MotorMode::Mit { .. }));
    let other_fault = if has_damping { Stop::Damp } else { Stop::Hold };
    let default = StopSpec { other_fault, ..StopSpec::default() };
    let mut choice = |key| {
        let stop = entry.has(key).then(|| entry.choice(problems, key, &Stop::WORDS)).flatten()?;
        if stop == Stop::Brake && !entry.has("brake") {
            let fix = format!("write {BRAKE}, or another way to stop");
            entry.report(problems, key, format!("{key} = \"brake\", and the motor has no brake"), fix);
        }
        if stop == Stop::Damp && !has_damping {
            let fix = "write \"hold\", which it does with all its torque, \"limp\" or \"brake\"";
            entry.report(problems, key, "a motor that runs its own loop cannot be damped".to_owned(), fix);
        }
        Some(stop)
    };
    let (own_fault, other_fault) = (choice("own_fault"), choice("other_fault"));
    let emergency = choice("emergency");
    StopSpec {
        own_fault: own_fault.unwrap_or(default.own_fault),
        other_fault: other_fault.unwrap_or(default.other_fault),
        emergency: emergency.unwrap_or(default.emergency),
        hold_for: or_never(entry, problems, "hold_for", Duration::from_millis(10), default.hold_for),
    }
}

/// The brake of the joint, if it has one.
pub(super) fn brake(entry: &Section<'_>, problems: &mut Problems<'_>) -> Option<BrakeSpec> {
    let table = entry.table(problems, "brake")?;
    table.allow(problems, &["chip", "line", "released", "engages_in", "releases_in"]);
    let (chip, line) = gpio_line(&table, problems);
    if !table.has("released") {
        let fix = "write released = \"high\" or \"low\": the level that lets the joint turn, best the one that a broken wire \
                   does not have";
        table.missing(problems, "released", fix);
    }
    let released = table.choice(problems, "released", &LEVELS);
    let mut time = |key| table.duration(problems, key, Duration::ZERO..=BrakeSpec::SLOWEST).unwrap_or(BRAKE_TIME);
    let (engages_in, releases_in) = (time("engages_in"), time("releases_in"));
    Some(BrakeSpec { chip: chip?, line: line?, released_high: released?, engages_in, releases_in })
}

/// A time of `least` to an hour, or the word "never".
pub(super) fn or_never(
    table: &Section<'_>,
    problems: &mut Problems<'_>,
    key: &str,
    least: Duration,
    default: Option<Duration>,
) -> Option<Duration> {
    if !table.has(key) {
        return default;
    }
    let mut fields = table.fields().into_iter();
    let is_never = fields.any(|(_, name, value)| name == key && value.get_ref().as_str() == Some("never"));
    if is_never { None } else { table.duration(problems, key, least..=Duration::from_hours(1)) }
}
