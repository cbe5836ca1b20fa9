//! Compiles each recorded schema to the `FileDescriptorSet` that MCAP wants beside the messages:
//! the schema's file and everything it imports. Says whether the library that policies need is at
//! hand.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::Command;

const PROTO: &str = "src/record/proto";
const SCHEMAS: [&str; 8] = [
    "foxglove/CompressedImage",
    "foxglove/Log",
    "foxglove/RawImage",
    "rapid/Bytes",
    "rapid/Event",
    "rapid/Frame",
    "rapid/Mask",
    "rapid/Scalars",
];

/// The pinned files of onnxruntime, as `sha256sum` lists them: `<sum>  <arch>/<file>`.
const PINNED: &str = "scripts/onnxruntime.sha256";
const LIBRARY: &str = "libonnxruntime.so.";

fn main() -> Result<(), Box<dyn Error>> {
    onnxruntime()?;
    commit();
    println!("cargo::rerun-if-changed={PROTO}");
    println!("cargo::rerun-if-changed=build.rs");
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    for schema in SCHEMAS {
        let mut compiler = protox::Compiler::new([PROTO])?;
        compiler.include_imports(true).include_source_info(false).open_file(format!("{schema}.proto"))?;
        let set = compiler.encode_file_descriptor_set();
        std::fs::write(out.join(format!("{}.bin", schema.replace('/', "."))), set)?;
    }
    Ok(())
}

/// Names the commit a release is built from. A source archive has none. Builds for development have
/// none either: each commit would build them anew.
fn commit() {
    // Asked for here and not found by git itself: the archive may lie in somebody else's repository.
    if std::env::var("PROFILE").as_deref() != Ok("release") || !Path::new(".git").exists() {
        return;
    }
    let ask = |arguments: &[&str]| {
        let output = Command::new("git").args(arguments).output().ok().filter(|output| output.status.success())?;
        Some(String::from_utf8(output.stdout).ok()?.trim().to_owned())
    };
    // It grows whenever another commit is checked out or made.
    if let Some(log) = ask(&["rev-parse", "--git-path", "logs/HEAD"]).filter(|log| Path::new(log).exists()) {
        println!("cargo::rerun-if-changed={log}");
    }
    if let Some(commit) = ask(&["rev-parse", "HEAD"]) {
        println!("cargo::rustc-env=RAPID_COMMIT={commit}");
    }
}

/// This version runs no policy and embeds nothing: it says what a build leaves out, so that nobody
/// who builds by hand is surprised later.
fn onnxruntime() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed={PINNED}");
    let arch = std::env::var("CARGO_CFG_TARGET_ARCH")?;
    let pinned = std::fs::read_to_string(PINNED)?;
    let version =
        pinned.lines().find_map(|line| line.split_whitespace().nth(1)?.strip_prefix(&format!("{arch}/{LIBRARY}")));
    // Where `make setup` puts it. A path that does not exist is not watched: cargo would run this
    // script at every build.
    let cache = std::env::var_os("XDG_CACHE_HOME")
        .map(PathBuf::from)
        .or_else(|| Some(PathBuf::from(std::env::var_os("HOME")?).join(".cache")));
    let library = cache
        .zip(version)
        .map(|(cache, version)| cache.join(format!("rapid/onnxruntime/{version}-{arch}/{LIBRARY}{version}")))
        .filter(|path| path.is_file());
    let (Some(library), Some(version)) = (library, version) else {
        println!(
            "cargo::warning=built without onnxruntime, which `make setup` fetches: recording needs none, and \
             this version runs no policy"
        );
        println!("cargo::rustc-env=RAPID_BUILT_WITH=onnxruntime: left out (this version runs no policy)");
        return Ok(());
    };
    println!("cargo::rerun-if-changed={}", library.display());
    println!(
        "cargo::rustc-env=RAPID_BUILT_WITH=onnxruntime: {version} at hand, not embedded (this version runs no policy)"
    );
    Ok(())
}
