//! `vbench-deaf [--json]`: the longest silence of the mask while nothing happens, while a program that ends promptly
//! loses its device, while one that ignores SIGTERM does, and beside programs that crash and that flood their stderr. A
//! benchmark: it prints figures and asserts nothing about them.

use std::process::ExitCode;

use vbench::deaf;
use vbench::figure::heading;

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
    let outcome = deaf::scenario().emulated().run()?;
    if !matches!(outcome.rapid_code, Some(0 | 4)) {
        return Err(outcome.diagnosis().into());
    }
    let figures = deaf::figures(&outcome);
    if !json {
        println!("{}", heading());
    }
    for figure in figures {
        if json { println!("{}", figure.json()) } else { println!("{figure}") }
    }
    Ok(())
}
