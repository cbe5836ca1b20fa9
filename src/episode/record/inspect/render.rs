//! An [`Inspection`] as text for a terminal.

use std::collections::BTreeMap;
use std::fmt::Write;

use rapid_core::text;
use rapid_status::Grade;
use rapid_status::palette::Palette;

use super::{FileEnd, Inspection, Judgement, Lateness, ModalityReport, PolicyReport, TopicReport};
use super::{policy, units};
use crate::record::Spread;

/// Events shown; the JSON form has all of them.
const EVENTS: usize = 40;
/// Narrowest timeline.
const TIMELINE: usize = 10;

/// The report in lines of at most `width` characters, as far as names allow.
pub fn render(inspection: &Inspection, width: usize, palette: Palette) -> String {
    let mut out = String::new();
    // Writing to a string cannot fail.
    let _ = write_all(&mut out, inspection, width, palette);
    out
}

fn write_all(out: &mut String, inspection: &Inspection, width: usize, palette: Palette) -> std::fmt::Result {
    write_head(out, inspection, palette)?;
    let names = inspection.modalities.iter().map(|modality| clean(&modality.name).chars().count());
    let topics = inspection.topics.iter().map(|topic| clean(&topic.topic).chars().count());
    let column = names.chain(topics).max().unwrap_or(0).max(8);
    write_topics(out, inspection, column)?;
    write_presence(out, inspection, column, width, palette)?;
    write_units(out, inspection, column, width)?;
    if let Some(policy) = &inspection.policy {
        write_policy(out, policy, width)?;
    }
    write_events(out, inspection, width)
}

fn write_head(out: &mut String, inspection: &Inspection, palette: Palette) -> std::fmt::Result {
    let name = inspection.file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    writeln!(out, "{}  {}", clean(&name), ending(inspection, palette))?;
    for text in inspection.left_out.sentences(inspection.damaged_chunks) {
        writeln!(out, "{}", palette.bad(&text))?;
    }
    if inspection.ordered_messages > 0 {
        let text = super::state::unverified(inspection.ordered_messages);
        writeln!(out, "{}", palette.warn(&text))?;
    }
    if let Some(source) = inspection.recovered.get("source") {
        writeln!(out, "{}", palette.warn(&clean(&repair(source, &inspection.recovered))))?;
    }
    write_verdict(out, inspection, palette)?;
    let mut about = vec![format!("task {}", or_dash(&inspection.task)), format!("rig {}", or_dash(&inspection.rig))];
    about.extend(inspection.tags.iter().map(|(key, value)| format!("{key}={value}")));
    writeln!(out, "{}", clean(&about.join("   ")))?;
    let dropped = inspection.dropped.map_or("?".to_owned(), |dropped| dropped.to_string());
    writeln!(
        out,
        "{:.3} s   {}   {} messages   {} frames   {dropped} dropped",
        inspection.seconds,
        text::size(inspection.bytes),
        inspection.messages,
        inspection.frames
    )?;
    let others = [(inspection.lost, "lost by the devices themselves"), (inspection.damaged, "damaged")];
    let others: Vec<_> = others
        .into_iter()
        .filter_map(|(count, what)| Some(format!("{} {what}", count.filter(|count| *count > 0)?)))
        .collect();
    if !others.is_empty() {
        writeln!(out, "{}", palette.warn(&others.join(", ")))?;
    }
    Ok(())
}

fn write_topics(out: &mut String, inspection: &Inspection, column: usize) -> std::fmt::Result {
    writeln!(
        out,
        "\n{:column$} {:>8} {:>7} {:>7} {:>7} {:>17} {:>6}",
        "", "messages", "Hz", "missing", "gap ms", "late p50/99/max", "frames"
    )?;
    for modality in &inspection.modalities {
        let frames = percent(modality.frames_valid as f64 / (inspection.frames.max(1)) as f64);
        let frames = if inspection.frames == 0 { "-".to_owned() } else { frames };
        write_topic(out, &modality.name, &modality.topic, &format!(" {frames:>6}"), column)?;
    }
    for topic in &inspection.topics {
        write_topic(out, &topic.topic, topic, "", column)?;
    }
    Ok(())
}

fn write_presence(
    out: &mut String,
    inspection: &Inspection,
    column: usize,
    width: usize,
    palette: Palette,
) -> std::fmt::Result {
    if let Some(Spread { p50, p95, max, .. }) = inspection.skew {
        writeln!(out, "\nsamples of a frame lie {p50:.1}/{p95:.1}/{max:.1} ms apart (p50/95/max)")?;
    }
    writeln!(out, "\npresence")?;
    let cells = width.saturating_sub(column + 8).max(TIMELINE);
    for modality in &inspection.modalities {
        let share = modality.presence.map_or("?".to_owned(), percent);
        let line = timeline(modality, inspection.seconds, cells, palette);
        writeln!(out, "{:column$} {line} {share:>6}", clean(&modality.name))?;
    }
    Ok(())
}

fn write_units(out: &mut String, inspection: &Inspection, column: usize, width: usize) -> std::fmt::Result {
    if !inspection.units.is_empty() {
        writeln!(out, "\nunits")?;
    }
    for (name, epochs) in &inspection.units {
        let mut name = clean(name);
        for epoch in epochs {
            let words: Vec<_> = units::words(epoch).iter().map(|word| clean(word)).collect();
            out.push_str(&wrapped(&format!("{name:column$} "), &words, width));
            name.clear();
        }
    }
    Ok(())
}

fn write_events(out: &mut String, inspection: &Inspection, width: usize) -> std::fmt::Result {
    // Chunks of a policy are summed up above.
    let events: Vec<_> = inspection.events.iter().filter(|event| event.kind != "chunk").collect();
    if !events.is_empty() {
        writeln!(out, "\nevents")?;
        for event in events.iter().take(EVENTS) {
            let line = format!("{:>10.3} s  {:12} {}", event.at, clean(&event.kind), clean(&event.text));
            writeln!(out, "{}", line.chars().take(width.max(TIMELINE)).collect::<String>())?;
        }
        if events.len() > EVENTS {
            writeln!(out, "{:>10}    {} more", "", events.len() - EVENTS)?;
        }
    }
    Ok(())
}

fn write_policy(out: &mut String, policy: &PolicyReport, width: usize) -> std::fmt::Result {
    writeln!(out, "\npolicy   latency p50/99/max")?;
    let (words, reasons) = policy::words(policy);
    let words: Vec<_> = words.iter().map(|word| clean(word)).collect();
    out.push_str(&wrapped("", &words, width));
    for reason in reasons {
        writeln!(out, "  {}", clean(&reason))?;
    }
    Ok(())
}

fn write_verdict(out: &mut String, inspection: &Inspection, palette: Palette) -> std::fmt::Result {
    let Judgement::Episode(verdict) = &inspection.verdict else {
        return writeln!(out, "{}", palette.warn(&clean(&inspection.verdict.reasons().join("; "))));
    };
    let mut line = palette.grade(verdict.grade, verdict.grade.word());
    if let Some(sensors) = &verdict.sensors {
        write!(line, "   {}", clean(&sensors.counted()))?;
    }
    if let Some(recorded) = inspection.recorded_verdict.as_ref().filter(|recorded| !recorded.agrees_with(verdict)) {
        let other = palette.grade(recorded.grade, recorded.grade.word());
        write!(line, "   when it was recorded: {other} {}", clean(&recorded.why()))?;
    }
    writeln!(out, "{line}")?;
    for file in &verdict.replay_of {
        writeln!(out, "  {}", clean(&format!("replay of {file}")))?;
    }
    for absence in verdict.sensors.iter().flat_map(|sensors| &sensors.away) {
        writeln!(out, "  {}", clean(&absence.to_string()))?;
    }
    for reason in &verdict.reasons {
        writeln!(out, "  {}", clean(reason))?;
    }
    Ok(())
}

/// `words` behind `head`, two blanks apart, in lines of at most `width` characters, as far as words
/// allow; further lines are set in a little more.
fn wrapped(head: &str, words: &[String], width: usize) -> String {
    let indent = head.chars().count();
    let mut text = head.to_owned();
    let mut used = indent;
    for (index, word) in words.iter().enumerate() {
        let length = word.chars().count();
        let space = if index == 0 {
            String::new()
        } else if used + 2 + length > width {
            used = indent;
            format!("\n{:indent$}  ", "")
        } else {
            "  ".to_owned()
        };
        used += if index == 0 { length } else { 2 + length };
        text.push_str(&space);
        text.push_str(word);
    }
    text.push('\n');
    text
}

/// What a repair left out when it made this file.
fn repair(source: &str, recovered: &BTreeMap<String, String>) -> String {
    const COUNTED: &[&str] = &[
        "damaged_chunks",
        "gaps",
        "oversized_records",
        "swollen_chunks",
        "excess_records",
        "repeated_chunks",
        "nameless_messages",
        "unproven_messages",
        "other_chunks",
        "bytes_before",
        "bytes_behind",
        "refused_records",
        "ordered_messages",
    ];
    let counts = COUNTED.iter().filter_map(|key| Some((key, recovered.get(*key).filter(|count| *count != "0")?)));
    let counts: Vec<String> = counts.map(|(key, count)| format!("{} {count}", key.replace('_', " "))).collect();
    let counts = if counts.is_empty() { "nothing left out".to_owned() } else { counts.join(", ") };
    format!("repaired from {source}: {counts}")
}

fn ending(inspection: &Inspection, palette: Palette) -> String {
    let unread = text::size(inspection.unread_bytes);
    match inspection.end {
        FileEnd::Finished => palette.good("complete"),
        FileEnd::Unfinished => palette.warn("INCOMPLETE: no footer, read to its end"),
        FileEnd::Torn => palette.warn(&format!("INCOMPLETE: the last record is cut, {unread} of it not whole")),
        FileEnd::Damaged => palette.bad(&format!("DAMAGED: {unread} cannot be read")),
    }
}

fn write_topic(out: &mut String, name: &str, topic: &TopicReport, frames: &str, column: usize) -> std::fmt::Result {
    let late =
        topic.lateness.map_or("-".to_owned(), |Lateness { p50, p99, max }| format!("{p50:.1}/{p99:.1}/{max:.1}"));
    // A handful of messages has no meaningful rate.
    let hz = if topic.messages < 10 { "-".to_owned() } else { format!("{:.2}", topic.hz) };
    writeln!(
        out,
        "{:column$} {:>8} {hz:>7} {:>7} {:>7.0} {late:>17}{frames}",
        clean(name),
        topic.messages,
        topic.missing,
        topic.longest_gap * 1e3,
    )
}

/// One character a cell of time: present throughout, absent throughout, or both.
fn timeline(modality: &ModalityReport, seconds: f64, cells: usize, palette: Palette) -> String {
    if modality.presence.is_none() {
        return "·".repeat(cells);
    }
    let mut line = String::new();
    let (mut run, mut run_grade) = (String::new(), Grade::Good);
    for cell in 0..cells {
        let begin = seconds * cell as f64 / cells as f64;
        let end = seconds * (cell + 1) as f64 / cells as f64;
        let together: f64 = modality.present.iter().map(|(from, to)| (to.min(end) - from.max(begin)).max(0.0)).sum();
        let share = if end > begin { together / (end - begin) } else { 0.0 };
        // A rounding error is neither presence nor absence.
        let (grade, glyph) = match share {
            share if share > 0.999 => (Grade::Good, '█'),
            share if share < 0.001 => (Grade::Bad, '░'),
            _ => (Grade::Suspect, '▓'),
        };
        if grade != run_grade && !run.is_empty() {
            line.push_str(&palette.grade(run_grade, &run));
            run.clear();
        }
        run_grade = grade;
        run.push(glyph);
    }
    line.push_str(&palette.grade(run_grade, &run));
    line
}

/// Text of a file, without what could move the cursor of a terminal.
pub(super) fn clean(text: &str) -> String {
    text::plain(text).into_owned()
}

fn or_dash(text: &str) -> &str {
    if text.is_empty() { "-" } else { text }
}

fn percent(share: f64) -> String {
    // Only what is whole is 100 %.
    let percent = if share < 1.0 { (share * 100.0).clamp(0.0, 99.0) } else { 100.0 };
    // An empty sum of floats is minus zero.
    format!("{:.0} %", percent.abs())
}
