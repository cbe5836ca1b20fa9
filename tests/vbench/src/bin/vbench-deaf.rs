//! `vbench-deaf [--json]`: the longest silence of the mask while nothing happens, while a program that ends promptly loses its
//! device, while a deaf one does, and beside programs that crash and that flood their stderr. A benchmark: it prints figures
//! and asserts nothing about them.

use std::process::ExitCode;

use vbench::deaf::{self, Span};
use vbench::figure::{Figure, heading};

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("vbench-deaf: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> Result<(), Box<dyn std::error::Error>> {
    let json = match std::env::args().nth(1).as_deref() {
        None => false,
        Some("--json") => true,
        Some(_) => return Err("usage: vbench-deaf [--json]".into()),
    };
    let outcome = deaf::scenario().run()?;
    if outcome.rapid_code != Some(0) {
        return Err(outcome.diagnosis().into());
    }
    let idle = deaf::rhythm(&outcome, Span::Idle).map(|rhythm| rhythm.longest_ms);
    if !json {
        println!("{}", heading());
    }
    for (span, name, note) in [
        (Span::Idle, "mask_silence_idle", "longest silence of the mask in 7 s in which nothing happens"),
        (Span::Prompt, "mask_silence_prompt_child", "in the 7 s after an unplug whose program ends on SIGTERM"),
        (Span::Deaf, "mask_silence_deaf_child", "in the 7 s after an unplug whose program ignores SIGTERM"),
        (Span::Crashing, "mask_silence_crashing_child", "in 7 s in which a program crashes again and again"),
        (Span::Flooding, "mask_silence_flooding_child", "in 7 s in which a program floods its stderr"),
    ] {
        let rhythm = deaf::rhythm(&outcome, span);
        let own = rhythm
            .map_or_else(String::new, |rhythm| format!("; longest pause of the sampler {:.1} ms", rhythm.pause_ms));
        let figure = Figure::new(name, "ms", rhythm.map(|rhythm| rhythm.longest_ms));
        let figure = figure.baseline(idle.filter(|_| span != Span::Idle)).note(format!("{note}{own}"));
        let figure = Figure { target: idle.filter(|_| span == Span::Deaf), ..figure };
        if json { println!("{}", figure.json()) } else { println!("{figure}") }
    }
    Ok(())
}
