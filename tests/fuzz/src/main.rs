//! `fuzz list`, `fuzz seeds FOLDER`, `fuzz run TARGET FILE...`: what `scripts/fuzz.sh` needs, and a
//! case that was found, run again under a debugger.

use std::path::Path;
use std::process::ExitCode;

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let outcome = match words.as_slice() {
        ["list"] => {
            fuzz::TARGETS.iter().for_each(|target| println!("{}", target.name));
            Ok(())
        }
        ["seeds", folder] => seeds(Path::new(folder)),
        ["run", name, files @ ..] => run(name, files),
        _ => Err("fuzz list | fuzz seeds FOLDER | fuzz run TARGET FILE...".to_owned()),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("fuzz: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Writes the seeds of every target into a folder of its name.
fn seeds(folder: &Path) -> Result<(), String> {
    for target in fuzz::TARGETS {
        let folder = folder.join(target.name);
        std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        for (number, seed) in (target.seeds)().iter().enumerate() {
            let path = folder.join(format!("seed-{number:03}"));
            std::fs::write(&path, seed).map_err(|error| format!("{}: {error}", path.display()))?;
        }
    }
    Ok(())
}

fn run(name: &str, files: &[&str]) -> Result<(), String> {
    let target = fuzz::target(name).ok_or_else(|| format!("no target {name:?}; `fuzz list` names them"))?;
    for file in files {
        let bytes = std::fs::read(file).map_err(|error| format!("{file}: {error}"))?;
        (target.run)(&bytes);
        println!("{file}: {} bytes, no complaint", bytes.len());
    }
    Ok(())
}
