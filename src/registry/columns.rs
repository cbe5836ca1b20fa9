//! Columns of vectors by name, as `[export]` and the options of `rapid export` choose them.
//!
//! `arm` is all numbers of that sensor, `arm.3` the fourth, `arm.0-5` the first six. Where the registry names numbers (joints
//! and poses, and the axes of an action), `arm.shoulder.position` is one of them, `arm.shoulder` all of that joint and
//! `arm.position` the positions of all joints, in the order of the sample.

use std::collections::BTreeSet;

/// Columns that a message lists; of more it lists the first.
const LISTED: usize = 40;

/// Numbers that can be chosen: those of a sensor, or of the topic of actions.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Vector {
    /// Of the sensor, or the topic; contains no dot.
    pub name: String,
    /// How many numbers it has, if that is known.
    pub length: Option<usize>,
    /// Their names; of another length than the vector they are not used.
    pub names: Vec<String>,
}

/// A choice that names nothing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ColumnError {
    /// No vector has the name.
    #[error("{name:?} is not a numeric sensor; those are {}", if known.is_empty() { "none" } else { known })]
    Unknown {
        /// The name.
        name: String,
        /// The names that can be chosen.
        known: String,
    },
    /// The vector has no such column.
    #[error("{text:?}: {name} has no column {which:?}; it has {known}")]
    NoColumn {
        /// As it was written.
        text: String,
        /// The vector.
        name: String,
        /// What follows its name.
        which: String,
        /// Its columns.
        known: String,
    },
    /// The number of a column is also the name of something else.
    #[error("{text:?} is ambiguous, a place and a part of {names}: write the place as a range (`3-3` for 3), or these")]
    Ambiguous {
        /// As it was written.
        text: String,
        /// What it names, by names.
        names: String,
    },
    /// How many columns the vector has is not known.
    #[error("{0}: how many values it has is not known")]
    NoLength(String),
    /// A column is chosen twice.
    #[error("{0:?} is chosen twice")]
    Twice(String),
}

impl Vector {
    /// The names of its columns, if there is one for each.
    pub fn named(&self) -> Option<&[String]> {
        Some(self.names.as_slice()).filter(|names| Some(names.len()) == self.length && !names.is_empty())
    }

    /// The columns that `which` names, by place or by name, ascending. `text` is what was written.
    fn columns(&self, text: &str, which: &str, length: usize) -> Result<Vec<usize>, ColumnError> {
        let named = self.by_name(which);
        let columns = match range(which) {
            Some((first, last)) if first <= last && last < length => {
                let placed: Vec<usize> = (first..=last).collect();
                // A joint may be called `1`.
                if !named.is_empty() && named != placed {
                    let of = |at: &usize| Some(format!("{}.{}", self.name, self.names.get(*at)?));
                    let ambiguous: Vec<String> = named.iter().filter_map(of).collect();
                    return Err(ColumnError::Ambiguous { text: text.to_owned(), names: ambiguous.join(", ") });
                }
                placed
            }
            _ => named,
        };
        if columns.is_empty() {
            let (text, name, which) = (text.to_owned(), self.name.clone(), which.to_owned());
            return Err(ColumnError::NoColumn { text, name, which, known: self.known(length) });
        }
        Ok(columns)
    }

    /// The columns of this name, or of which it is the joint or the quantity, ascending.
    fn by_name(&self, which: &str) -> Vec<usize> {
        let names = self.named().unwrap_or_default();
        if let Some(at) = names.iter().position(|name| name == which) {
            return vec![at];
        }
        // Names of joints may contain dots.
        let is_of_it = |name: &str| {
            name.strip_prefix(which).is_some_and(|rest| rest.starts_with('.'))
                || name.strip_suffix(which).is_some_and(|rest| rest.ends_with('.'))
        };
        (0..).zip(names).filter(|(_, name)| is_of_it(name)).map(|(at, _)| at).collect()
    }

    /// What it has, for a message.
    fn known(&self, length: usize) -> String {
        let Some(names) = self.named() else { return format!("0-{}", length.saturating_sub(1)) };
        let more = if names.len() > LISTED { ", ..." } else { "" };
        let listed: Vec<&str> = names.iter().take(LISTED).map(String::as_str).collect();
        format!("0-{}: {}{more}", length.saturating_sub(1), listed.join(", "))
    }
}

/// `3` or `0-5`.
fn range(text: &str) -> Option<(usize, usize)> {
    let number = |text: &str| {
        let is_number = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
        is_number.then(|| text.parse().unwrap_or(usize::MAX))
    };
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    Some((number(first)?, number(last)?))
}

/// The columns that `parts` name, in that order: the place of the vector, and of the number in it.
///
/// # Errors
/// When a part names nothing, or a column is named twice.
pub fn choose(parts: &[String], vectors: &[Vector]) -> Result<Vec<(usize, usize)>, ColumnError> {
    let (mut chosen, mut seen) = (Vec::new(), BTreeSet::new());
    for text in parts {
        let (name, which) = text.split_once('.').map_or((text.as_str(), None), |(name, which)| (name, Some(which)));
        let found = (0..).zip(vectors).find(|(_, vector)| vector.name == name);
        let (place, vector) = found.ok_or_else(|| ColumnError::Unknown {
            name: name.to_owned(),
            known: vectors.iter().map(|vector| vector.name.as_str()).collect::<Vec<_>>().join(", "),
        })?;
        let length = vector.length.ok_or_else(|| ColumnError::NoLength(name.to_owned()))?;
        let columns = which.map_or_else(|| Ok((0..length).collect()), |which| vector.columns(text, which, length))?;
        for column in columns {
            if !seen.insert((place, column)) {
                return Err(ColumnError::Twice(format!("{name}.{column}")));
            }
            chosen.push((place, column));
        }
    }
    Ok(chosen)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn vectors() -> Vec<Vector> {
        let names = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
        let joints = ["hip.position", "hip.velocity", "knee.position", "knee.velocity"];
        vec![
            Vector { name: "leg".to_owned(), length: Some(4), names: names(&joints) },
            Vector { name: "force".to_owned(), length: Some(2), names: names(&["x"]) },
            Vector { name: "late".to_owned(), length: None, names: Vec::new() },
        ]
    }

    fn chosen(parts: &[&str]) -> Result<Vec<(usize, usize)>, String> {
        let parts: Vec<String> = parts.iter().map(|part| (*part).to_owned()).collect();
        choose(&parts, &vectors()).map_err(|error| error.to_string())
    }

    #[test]
    fn columns_are_named_by_number_by_name_by_joint_and_by_quantity() {
        assert_eq!(chosen(&["force", "leg.1-2"]).unwrap(), [(1, 0), (1, 1), (0, 1), (0, 2)]);
        assert_eq!(chosen(&["leg.3", "leg.0"]).unwrap(), [(0, 3), (0, 0)]);
        assert_eq!(chosen(&["leg.knee.position"]).unwrap(), [(0, 2)]);
        assert_eq!(chosen(&["leg.knee"]).unwrap(), [(0, 2), (0, 3)]);
        assert_eq!(chosen(&["leg.position"]).unwrap(), [(0, 0), (0, 2)]);
        assert_eq!(chosen(&[]).unwrap(), []);
    }

    #[test]
    fn what_names_nothing_is_refused_with_what_there_is() {
        let refused = |parts: &[&str]| chosen(parts).unwrap_err();
        assert_eq!(refused(&["arm.0"]), "\"arm\" is not a numeric sensor; those are leg, force, late");
        let known = "it has 0-3: hip.position, hip.velocity, knee.position, knee.velocity";
        for which in ["4", "2-4", "3-2", "99999999999999999999999", "hips", "hip.", "", "1-", "-1"] {
            assert_eq!(
                refused(&[&format!("leg.{which}")]),
                format!("\"leg.{which}\": leg has no column {which:?}; {known}")
            );
        }
        // The names are of another length than the samples.
        assert_eq!(refused(&["force.x"]), "\"force.x\": force has no column \"x\"; it has 0-1");
        assert_eq!(refused(&["leg.1-2", "leg.position"]), "\"leg.2\" is chosen twice");
        assert_eq!(refused(&["late.0"]), "late: how many values it has is not known");
    }

    #[test]
    fn a_name_that_is_also_a_place_is_refused() {
        let of = |names: &[&str], which: &str| {
            let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
            let vector = Vector { name: "leg".to_owned(), length: Some(names.len()), names };
            choose(&[format!("leg.{which}")], &[vector]).map_err(|error| error.to_string())
        };
        let joints = ["1.position", "1.velocity", "2.position", "2.velocity"];
        let fix = "write the place as a range (`3-3` for 3), or these";
        let ambiguous = format!("\"leg.1\" is ambiguous, a place and a part of leg.1.position, leg.1.velocity: {fix}");
        assert_eq!(of(&joints, "1"), Err(ambiguous));
        assert_eq!(of(&joints, "1-1").unwrap(), [(0, 1)]);
        assert_eq!(of(&joints, "1.position").unwrap(), [(0, 0)]);
        assert_eq!(of(&joints, "3").unwrap(), [(0, 3)]);
        // Both are the same column, or there is no such place.
        assert_eq!(of(&["0", "1"], "1").unwrap(), [(0, 1)]);
        assert_eq!(of(&["7.position", "7.velocity"], "7").unwrap(), [(0, 0), (0, 1)]);
        assert!(of(&["1", "0"], "1").unwrap_err().contains("a part of leg.1:"));
    }
}
