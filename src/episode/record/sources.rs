//! What an episode's samples come from, as far as it is a reason: a recording that was replayed, another unit that took
//! over within the episode.
//!
//! Both follow from the epochs of the modalities, as they are in the file: the recorder and `inspect` find the same.
//!
//! Invariant: pure; no text of a file causes a panic, and what is in an unexpected format is omitted.

use std::collections::BTreeMap;

use rapid_core::provenance::ReplaySource;
use rapid_status::Grade;
use serde_json::Value;

/// The epochs of each modality, in the order of time.
pub(super) type Epochs = BTreeMap<String, Vec<Value>>;

/// Key of both records of metadata: the recordings that were replayed.
pub(super) const REPLAY_OF: &str = "replay_of";
/// Units of a modality that a reason names; a file may hold any number.
const MOST_UNITS: usize = 4;

/// The recordings that these samples come from, each once.
pub(super) fn replayed(epochs: &Epochs) -> Vec<ReplaySource> {
    let mut found: Vec<ReplaySource> = Vec::new();
    for epoch in epochs.values().flatten() {
        let replayed = epoch.get("replay_of").and_then(|of| serde_json::from_value::<ReplaySource>(of.clone()).ok());
        found.extend(replayed.filter(|replayed| !found.contains(replayed)));
    }
    found
}

/// Why an episode of so many seconds with these epochs is not GOOD.
pub(super) fn reasons(epochs: &Epochs, seconds: f64) -> Vec<(Grade, String)> {
    let replayed = replayed(epochs).into_iter().filter_map(|replayed| not_good(&replayed));
    let others = epochs.iter().filter_map(|(name, epochs)| units(name, epochs, seconds));
    replayed.chain(others.map(|text| (Grade::Suspect, text))).collect()
}

/// A replay is no better than its source.
fn not_good(replayed: &ReplaySource) -> Option<(Grade, String)> {
    let ReplaySource { verdict, reasons, .. } = replayed;
    let grade = [Grade::Good, Grade::Suspect, Grade::Bad].into_iter().find(|grade| grade.word() == verdict);
    let (grade, is) = match grade {
        Some(Grade::Good) => return None,
        Some(grade) => (grade, grade.word()),
        None => (Grade::Suspect, "without a verdict"),
    };
    let why = if reasons.is_empty() { String::new() } else { format!(": {}", reasons.join("; ")) };
    Some((grade, format!("replay of {}, which is {is}{why}", replayed.name())))
}

/// Names the units of a modality if there were several.
fn units(name: &str, epochs: &[Value], seconds: f64) -> Option<String> {
    let time = |epoch: &Value, key: &str| epoch.get(key).and_then(Value::as_f64);
    let is_within = |epoch: &&Value| {
        time(epoch, "from_s").is_some_and(|from| from < seconds) && time(epoch, "to_s").is_none_or(|to| to > 0.0)
    };
    let mut units: Vec<(String, f64)> = Vec::new();
    for epoch in epochs.iter().filter(is_within) {
        let unit = unit(epoch);
        if units.last().is_none_or(|(last, _)| *last != unit) {
            units.push((unit, time(epoch, "from_s").unwrap_or(0.0)));
        }
    }
    let ((first, _), others) = units.split_first().filter(|(_, others)| !others.is_empty())?;
    let count = units.len();
    let others = others.iter().take(MOST_UNITS - 1).map(|(unit, from)| format!("{unit} from {from:.1} s"));
    let named: Vec<String> = std::iter::once(first.clone()).chain(others).collect();
    Some(format!("{name}: {count} units took part: {}", named.join(", then ")))
}

/// A unit in words, without where it was plugged in or what its address was.
fn unit(epoch: &Value) -> String {
    let text = |key: &str| epoch.get(key).and_then(Value::as_str);
    if text("address").is_some() {
        return text("instance").map_or("one without a name".to_owned(), str::to_owned);
    }
    let model = format!("{}:{}", text("vid").unwrap_or("?"), text("pid").unwrap_or("?"));
    match text("serial") {
        Some(serial) => format!("{model} serial {serial}"),
        None => format!("{model} without a serial number"),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn epoch(from: f64, to: Option<f64>, serial: Option<&str>, port: &str) -> Value {
        json!({"from_s": from, "to_s": to, "vid": "046d", "pid": "0825", "serial": serial, "port": port})
    }

    #[test]
    fn units_are_named_where_there_are_several_within_the_episode() {
        let of = |epochs: Vec<Value>| reasons(&[("cam".to_owned(), epochs)].into(), 10.0);
        let one = |text: &str| vec![(Grade::Suspect, text.to_owned())];
        let a = |from, to| epoch(from, to, Some("A"), "1-1");
        let b = |from, to| epoch(from, to, Some("B"), "1-1");
        assert_eq!(of(vec![a(-1.0, Some(2.0)), epoch(4.0, None, Some("A"), "9-9")]), [], "the same in another port");
        assert_eq!(
            of(vec![a(-1.0, Some(2.0)), b(4.0, None)]),
            one("cam: 2 units took part: 046d:0825 serial A, then 046d:0825 serial B from 4.0 s")
        );
        assert_eq!(
            of(vec![a(-1.0, Some(2.0)), b(4.0, Some(5.0)), a(6.0, None)]),
            one(
                "cam: 3 units took part: 046d:0825 serial A, then 046d:0825 serial B from 4.0 s, then 046d:0825 serial A from 6.0 s"
            )
        );
        assert_eq!(of(vec![a(-3.0, Some(-1.0)), b(-0.5, None)]), [], "it ended before the episode");
        assert_eq!(of(vec![a(-3.0, Some(9.9)), b(10.0, None)]), [], "it began after the episode");
        // Nothing distinguishes units of a model without serial numbers.
        assert_eq!(of(vec![epoch(0.0, Some(1.0), None, "1-1"), epoch(2.0, None, None, "1-2")]), []);
        let of_phones = |names: [&str; 2]| {
            let phone = |name: &str| json!({"from_s": 1.0, "to_s": null, "instance": name, "address": "10.0.0.9:80"});
            of(names.map(phone).to_vec())
        };
        assert_eq!(of_phones(["left", "left"]), []);
        assert_eq!(of_phones(["left", "right"]), one("cam: 2 units took part: left, then right from 1.0 s"));
        assert_eq!(of(vec![json!([7]), json!({"from_s": "x"})]), []);
    }

    #[test]
    fn a_replay_is_no_better_than_its_source() {
        let of = |verdict: &str, reasons: &[&str]| {
            let of = json!({"file": "/out/a.mcap", "begin_ns": 7, "verdict": verdict, "reasons": reasons});
            let epoch = json!({"from_s": -1.0, "to_s": null, "vid": "1", "pid": "2", "serial": "A", "replay_of": of});
            let epochs = [("cam".to_owned(), vec![epoch.clone()]), ("state".to_owned(), vec![epoch])].into();
            assert_eq!(replayed(&epochs).len(), 1);
            super::reasons(&epochs, 10.0)
        };
        assert_eq!(of("GOOD", &[]), []);
        let lost = "cam: 30 of 240 samples lost by the device (limit 5 %)";
        let because = format!("replay of a.mcap, which is BAD: {lost}; cut");
        assert_eq!(of("BAD", &[lost, "cut"]), [(Grade::Bad, because)]);
        assert_eq!(of("SUSPECT", &["x"]), [(Grade::Suspect, "replay of a.mcap, which is SUSPECT: x".to_owned())]);
        let without = "replay of a.mcap, which is without a verdict: not an episode of rapid";
        assert_eq!(of("", &["not an episode of rapid"]), [(Grade::Suspect, without.to_owned())]);
    }
}
