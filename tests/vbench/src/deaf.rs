//! Devices read by misbehaving programs, while a sampler reads the mask: two are unplugged in turn, and the program of
//! the second ignores SIGTERM; of two plugged in later, one program crashes repeatedly, one floods stderr.
//!
//! Invariant: spans of equal length in one guest are compared: an idle one, and one for each of the above.

use crate::emu::spec::DeviceSpec;
use crate::figure::Figure;
use crate::outcome::Outcome;
use crate::rhythm::Rhythm;
use crate::scenario::Scenario;

/// Length of each span: SIGTERM may take 5 s, after which the program is killed.
pub const SPAN_MS: u64 = 6_000;
const IDLE_MS: u64 = 1_000;
const PROMPT_MS: u64 = 7_000;
const DEAF_MS: u64 = 13_000;
const CRASH_MS: u64 = 19_000;
const FLOOD_MS: u64 = 25_000;
/// Time until the end of the last span.
const SECONDS: u32 = 31;
/// Between the first and the fifth crash are 7.5 s of waiting, and four starts, which emulated processors take seconds for.
const CRASHED: &str = r#"has_lines 5 $out/rapid.jsonl 'crashes after 50 samples'"#;
const REGISTRY: &str = r#"
[rig]
name = "vbench"

[device.prompt]
vid = "0x2e8a"
pid = "0x000a"
serial = "P1"
node = "process_node"
bit = 0
[device.prompt.process]
kind = "scalars"
channels = 2
opens = "tty"

[device.deaf]
vid = "0x2e8a"
pid = "0x000a"
serial = "D1"
node = "process_node"
bit = 1
[device.deaf.process]
args = ["--ignore-sigterm"]
kind = "scalars"
channels = 2

[device.crashing]
vid = "0x2e8a"
pid = "0x000a"
serial = "C1"
node = "process_node"
bit = 2
[device.crashing.process]
args = ["--crash-after", "50"]
kind = "scalars"
channels = 2

[device.flooding]
vid = "0x2e8a"
pid = "0x000a"
serial = "F1"
node = "process_node"
bit = 3
[device.flooding.process]
args = ["--flood-stderr"]
kind = "scalars"
channels = 2
"#;

/// What happens in a span.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Span {
    /// Nothing.
    Idle,
    /// The device of the program that ends on SIGTERM is unplugged at its beginning.
    Prompt,
    /// The device of the program that ignores SIGTERM is unplugged.
    Deaf,
    /// A device is plugged at its start whose program crashes after half a second, each time.
    Crashing,
    /// A device whose program writes to its stderr as fast as it can.
    Flooding,
}

/// The scenario.
pub fn scenario() -> Scenario {
    Scenario::new("deaf")
        .device(DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("P1"))
        .device(DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("D1"))
        .spare(DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("C1"))
        .spare(DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("F1"))
        .registry(REGISTRY)
        .example("process_node")
        .record(SECONDS, &["prompt", "deaf"])
        .watch_mask()
        .at(PROMPT_MS, "unplug 0")
        .at(DEAF_MS, "unplug 1")
        .at(CRASH_MS, "plug 2")
        .at(FLOOD_MS, "plug 3")
        .until(CRASHED)
}

/// The mask's timing in a span; `None` if the sampler recorded nothing of it.
pub fn rhythm(outcome: &Outcome, span: Span) -> Option<Rhythm> {
    let offset = match span {
        Span::Idle => IDLE_MS,
        Span::Prompt => PROMPT_MS,
        Span::Deaf => DEAF_MS,
        Span::Crashing => CRASH_MS,
        Span::Flooding => FLOOD_MS,
    };
    let from = outcome.origins().first()?.mono_ns + offset * 1_000_000;
    Rhythm::between(outcome, from, from + SPAN_MS * 1_000_000)
}

/// The longest silence of the mask in each span, next to that of the idle one.
pub fn figures(outcome: &Outcome) -> Vec<Figure> {
    let idle = rhythm(outcome, Span::Idle).map(|rhythm| rhythm.longest_ms);
    let spans = [
        (Span::Idle, "mask_silence_idle", "longest silence of the mask in 6 s in which nothing happens"),
        (Span::Prompt, "mask_silence_prompt_child", "in the 6 s after an unplug whose program ends on SIGTERM"),
        (Span::Deaf, "mask_silence_deaf_child", "in the 6 s after an unplug whose program ignores SIGTERM"),
        (Span::Crashing, "mask_silence_crashing_child", "in 6 s in which a program crashes again and again"),
        (Span::Flooding, "mask_silence_flooding_child", "in 6 s in which a program floods its stderr"),
    ];
    let figure = |(span, name, note): (Span, &str, &str)| {
        let rhythm = rhythm(outcome, span);
        let pause = |rhythm: Rhythm| format!("; longest pause of the sampler {:.1} ms", rhythm.pause_ms);
        let own = rhythm.map_or_else(String::new, pause);
        let figure = Figure::new(name, "ms", rhythm.map(|rhythm| rhythm.longest_ms));
        let figure = figure.baseline(idle.filter(|_| span != Span::Idle)).note(format!("{note}{own}"));
        Figure { target: idle.filter(|_| span == Span::Deaf), ..figure }
    };
    spans.map(figure).to_vec()
}
