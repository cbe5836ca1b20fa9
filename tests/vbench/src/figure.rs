//! A measured figure with its baseline and target, as a line of a table or as a JSON object.

use std::fmt;

use serde_json::{Value, json};

/// One figure.
#[derive(Clone, Debug, PartialEq)]
pub struct Figure {
    /// Name of the measurement: letters, digits and `_`.
    pub name: String,
    /// Unit of all three values.
    pub unit: &'static str,
    /// The measured value; `None` if nothing could be measured.
    pub value: Option<f64>,
    /// The same measurement of the simplest possible program, in the same run.
    pub baseline: Option<f64>,
    /// The value that should not be exceeded, if there is one.
    pub target: Option<f64>,
    /// What was measured and how, for people.
    pub note: String,
}

impl Figure {
    /// A figure with neither baseline nor target.
    pub fn new(name: impl Into<String>, unit: &'static str, value: Option<f64>) -> Self {
        Self { name: name.into(), unit, value, baseline: None, target: None, note: String::new() }
    }

    /// Adds the value of the simplest possible program.
    #[must_use]
    pub fn baseline(mut self, baseline: Option<f64>) -> Self {
        self.baseline = baseline;
        self
    }

    /// Adds the value that should not be exceeded.
    #[must_use]
    pub fn target(mut self, target: f64) -> Self {
        self.target = Some(target);
        self
    }

    /// Adds a note.
    #[must_use]
    pub fn note(mut self, note: impl Into<String>) -> Self {
        self.note = note.into();
        self
    }

    /// As a JSON object: `name`, `unit`, `value`, `baseline`, `target` and `note`; missing values are null.
    pub fn json(&self) -> Value {
        let rounded = |value: Option<f64>| value.map(|value| (value * 1e3).round() / 1e3);
        json!({
            "name": self.name,
            "unit": self.unit,
            "value": rounded(self.value),
            "baseline": rounded(self.baseline),
            "target": self.target,
            "note": self.note,
        })
    }
}

impl fmt::Display for Figure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let cell =
            |value: Option<f64>, decimals| value.map_or_else(|| "-".into(), |value| format!("{value:.decimals$}"));
        write!(
            f,
            "{:<34} {:>9} {:>9} {:>7} {:<5} {}",
            self.name,
            cell(self.value, 2),
            cell(self.baseline, 2),
            cell(self.target, 0),
            self.unit,
            self.note
        )
    }
}

/// The header of a table of figures.
pub fn heading() -> String {
    format!("{:<34} {:>9} {:>9} {:>7} {:<5} {}", "figure", "value", "baseline", "target", "unit", "what it is")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_figure_names_missing_requirements() {
        let figure = Figure::new("unplug_to_bit_p50", "ms", Some(12.345_67)).target(100.0).note("x");
        assert_eq!(
            figure.json(),
            json!({"name": "unplug_to_bit_p50", "unit": "ms", "value": 12.346, "baseline": null, "target": 100.0, "note": "x"})
        );
        let line = figure.to_string();
        assert_eq!(line.split_whitespace().collect::<Vec<_>>(), ["unplug_to_bit_p50", "12.35", "-", "100", "ms", "x"]);
        assert_eq!(heading().find("unit"), line.find("ms"));
    }
}
