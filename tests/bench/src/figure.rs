//! Figures: measurements with baseline and target, as a table or as JSON.
//!
//! Invariant: a figure that could not be measured is shown with the reason, and states whether the machine lacks a
//! requirement; no value causes a failure here.

use std::fmt::Write as _;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{Absent, Failure};

/// One figure; as JSON one object per line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Figure {
    /// `section/what`.
    pub name: String,
    /// Unit of value, baseline and target; may be empty.
    #[serde(default)]
    pub unit: String,
    /// `None` if it was not measured; the note then gives the reason.
    pub value: Option<f64>,
    /// The same measurement of something simpler, in the same run.
    #[serde(default)]
    pub baseline: Option<f64>,
    /// The target: `"< 200"`, `">= 0.9"`, `"= 0"`; a bare number is an upper bound.
    #[serde(default)]
    pub target: Option<Value>,
    /// How it was measured, for people.
    #[serde(default)]
    pub note: String,
    /// Whether the value meets the target; `None` if either is missing.
    #[serde(default)]
    pub met: Option<bool>,
    /// There is no value because the machine lacks the requirement named in the note.
    #[serde(default)]
    pub absent: bool,
}

impl Figure {
    /// A measured figure.
    pub(crate) fn new(name: impl Into<String>, unit: &str, value: Option<f64>) -> Self {
        let (name, unit) = (name.into(), unit.to_owned());
        Self { name, unit, value, baseline: None, target: None, note: String::new(), met: None, absent: false }
    }

    /// A figure without a value.
    pub(crate) fn missing(name: impl Into<String>, why: impl Into<String>) -> Self {
        Self::new(name, "", None).note(why)
    }

    /// A figure without a value because its measurement failed.
    pub(crate) fn of_failure(name: impl Into<String>, why: &Failure) -> Self {
        Self { absent: why.is::<Absent>(), ..Self::missing(name, why.to_string()) }
    }

    /// It has no value, and the machine is not the reason.
    pub(crate) fn is_unmeasured(&self) -> bool {
        self.value.is_none_or(f64::is_nan) && !self.absent
    }

    /// Adds the baseline.
    #[must_use]
    pub(crate) fn baseline(mut self, baseline: Option<f64>) -> Self {
        self.baseline = baseline;
        self
    }

    /// Adds the target, in the notation of [`Figure::target`].
    #[must_use]
    pub(crate) fn target(mut self, target: &str) -> Self {
        self.target = Some(Value::from(target));
        self.judged()
    }

    /// Adds a note.
    #[must_use]
    pub(crate) fn note(mut self, note: impl Into<String>) -> Self {
        self.note = note.into();
        self
    }

    /// Sets `met` according to value and target.
    #[must_use]
    pub(crate) fn judged(mut self) -> Self {
        self.met = self.target.as_ref().and_then(|target| is_met(self.value?, &target_text(target)));
        self
    }

    fn verdict(&self) -> &'static str {
        match (self.value, self.met) {
            (None, _) if self.absent => "not here",
            (None, _) => "not measured",
            (_, Some(true)) => "met",
            (_, Some(false)) => "MISSED",
            (_, None) => "",
        }
    }
}

fn target_text(target: &Value) -> String {
    target.as_str().map_or_else(|| format!("<= {target}"), str::to_owned)
}

fn is_met(value: f64, target: &str) -> Option<bool> {
    let bound = target.trim_start_matches(['<', '>', '=']);
    let sign = &target[..target.len() - bound.len()];
    let bound: f64 = bound.split_whitespace().next()?.parse().ok()?;
    match sign {
        "<" => Some(value < bound),
        "<=" => Some(value <= bound),
        ">" => Some(value > bound),
        ">=" => Some(value >= bound),
        "=" | "==" => Some((value - bound).abs() < f64::EPSILON),
        _ => None,
    }
}

/// The figures of one section as a table.
pub(crate) fn table(title: &str, figures: &[Figure]) -> String {
    let short = |figure: &Figure| figure.name.split_once('/').map_or(figure.name.as_str(), |(_, what)| what).to_owned();
    let rows: Vec<[String; 6]> = figures
        .iter()
        .map(|figure| {
            [
                short(figure),
                figure.unit.clone(),
                figure.value.map_or_else(|| "-".to_owned(), number),
                figure.baseline.map_or_else(|| "-".to_owned(), number),
                figure.target.as_ref().map_or_else(|| "-".to_owned(), target_text),
                figure.verdict().to_owned(),
            ]
        })
        .collect();
    let head = ["", "", "value", "baseline", "target", ""].map(str::to_owned);
    let width = |column: usize| rows.iter().chain([&head]).map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: [usize; 6] = std::array::from_fn(width);
    let line = |row: &[String; 6]| {
        let [name, unit, value, baseline, target, verdict] = row;
        let [a, b, c, d, e, _] = widths;
        let text = format!("  {name:<a$}  {unit:<b$}  {value:>c$}  {baseline:>d$}  {target:>e$}  {verdict}");
        text.trim_end().to_owned()
    };
    let mut text = format!("{title}\n{}\n", line(&head));
    for (figure, row) in figures.iter().zip(&rows) {
        let _ = writeln!(text, "{}", line(row));
        if !figure.note.is_empty() {
            let _ = writeln!(text, "      {}", figure.note);
        }
    }
    text
}

/// Three significant digits, and at most three decimals.
fn number(value: f64) -> String {
    let decimals = match value.abs() {
        0.0 => 0,
        large if large >= 100.0 => 0,
        large if large >= 10.0 => 1,
        large if large >= 1.0 => 2,
        _ => 3,
    };
    if value.fract() == 0.0 { format!("{value:.0}") } else { format!("{value:.decimals$}") }
}

/// Parses the output of another program of the bench: lines that are figures; other lines are ignored.
pub(crate) fn read(text: &str) -> Vec<Figure> {
    text.lines().filter_map(|line| serde_json::from_str::<Figure>(line).ok()).map(Figure::judged).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_compared_with_their_targets() {
        for (value, target, met) in [
            (1.0, "< 1", Some(false)),
            (1.0, "<= 1", Some(true)),
            (0.9, ">= 0.9", Some(true)),
            (2.0, "> 2", Some(false)),
            (0.0, "= 0", Some(true)),
            (1.0, "about 1", None),
        ] {
            assert_eq!(Figure::new("a/b", "ms", Some(value)).target(target).met, met, "{value} {target}");
        }
        assert_eq!(Figure::missing("a/b", "why").target("< 1").met, None);
    }

    #[test]
    fn figures_of_other_programs_are_parsed_and_judged() {
        let text = "booting\n{\"name\":\"cycles/p50\",\"unit\":\"ms\",\"value\":3,\"baseline\":null,\"target\":2,\"note\":\"n\"}\n{}";
        let figures = read(text);
        assert_eq!(figures.len(), 1);
        assert_eq!((figures[0].met, figures[0].verdict()), (Some(false), "MISSED"));
        let again = read(&serde_json::to_string(&figures[0]).unwrap());
        assert_eq!(again, figures);
    }

    #[test]
    fn a_table_shows_met_missed_and_unmeasured_figures() {
        let figures = [
            Figure::new("load/cpu", "%", Some(12.345)).baseline(Some(3.0)).target("< 25").note("user and system"),
            Figure::new("load/drops", "", Some(2.0)).target("= 0"),
            Figure::missing("load/rss", "no /proc"),
        ];
        let expected = "\
load
            value  baseline  target
  cpu    %   12.3         3    < 25  met
      user and system
  drops         2         -     = 0  MISSED
  rss           -         -       -  not measured
      no /proc
";
        assert_eq!(table("load", &figures), expected);
    }

    #[test]
    fn only_figures_beyond_the_machine_may_be_unmeasured() {
        let failed = |why: Failure| Figure::of_failure("a/all", &why);
        assert!(failed("topic /rapid/mask: ExceedsMaxSupportedPublishers".into()).is_unmeasured());
        assert!(Figure::new("a/b", "ms", None).is_unmeasured());
        assert!(!Figure::new("a/b", "ms", Some(0.0)).is_unmeasured());
        let absent = failed(Absent("KVM".to_owned()).into());
        assert!(!absent.is_unmeasured());
        assert_eq!((absent.verdict(), absent.note.as_str()), ("not here", "this machine has no KVM"));
    }
}
