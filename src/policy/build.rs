//! Packs the libraries that policies need.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::Command;

use sha2::{Digest as _, Sha256};

/// The pinned files of onnxruntime, as `sha256sum` lists them: `<sum>  <arch>/<file>`.
const PINNED: &str = "../../scripts/onnxruntime.sha256";
const LIBRARY: &str = "libonnxruntime.so.";
/// What it needs beside libc, libm and `libgcc_s`, which the program itself needs.
const LIBSTDCXX: &str = "libstdc++.so.6";
/// Higher levels save a few percent and take many times as long, to pack and to unpack.
const LEVEL: i32 = 9;

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=build.rs");
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    onnxruntime(&out)?;
    libstdcxx(&out)
}

/// Packs the library that policies need for the program to carry: `onnxruntime.rs` includes
/// what is written here. Without the library that is an empty file, and the build continues: recording
/// needs none.
fn onnxruntime(out: &Path) -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed={PINNED}");
    // They give the place of the cache.
    println!("cargo::rerun-if-env-changed=XDG_CACHE_HOME");
    println!("cargo::rerun-if-env-changed=HOME");
    let arch = std::env::var("CARGO_CFG_TARGET_ARCH")?;
    let pinned = std::fs::read_to_string(PINNED)?;
    let entry = pinned.lines().find_map(|line| {
        let (sum, file) = line.split_once("  ")?;
        Some((sum, file.strip_prefix(&format!("{arch}/{LIBRARY}"))?))
    });
    // Where `make setup` puts it. A path that does not exist is not watched: cargo would run this
    // script at every build. `make setup` touches this script when it has fetched the library.
    let cache = std::env::var_os("XDG_CACHE_HOME")
        .map(PathBuf::from)
        .or_else(|| Some(PathBuf::from(std::env::var_os("HOME")?).join(".cache")));
    let library = cache.zip(entry).map(|(cache, (sum, version))| {
        (cache.join(format!("rapid/onnxruntime/{version}-{arch}/{LIBRARY}{version}")), sum, version)
    });
    let Some((library, sum, version)) = library.filter(|(path, ..)| path.is_file()) else {
        println!(
            "cargo::warning=built without onnxruntime, which `make setup` fetches: recording needs none, policies \
             will need --ort-lib or ORT_DYLIB_PATH"
        );
        println!("cargo::rustc-env=RAPID_BUILT_WITH=none built in (a policy needs --ort-lib or ORT_DYLIB_PATH)");
        let none = out.join("onnxruntime-none.zst");
        std::fs::write(&none, [])?;
        println!("cargo::rustc-env=RAPID_ONNXRUNTIME={}", none.display());
        return Ok(());
    };
    println!("cargo::rerun-if-changed={}", library.display());
    println!("cargo::rustc-env=RAPID_BUILT_WITH={version} (built in)");
    let bytes = std::fs::read(&library)?;
    if sha256(&bytes) != sum {
        return Err(
            format!("{} is not the file that {PINNED} names: remove it, then `make setup`", library.display()).into()
        );
    }
    println!("cargo::rustc-env=RAPID_ONNXRUNTIME={}", pack(out, "onnxruntime", &bytes)?.display());
    Ok(())
}

/// Packs the C++ library, which onnxruntime needs and a small machine may lack: that of the compiler of this
/// build, of which the program's own symbol versions come too. A build for another machine than this one, or on
/// one without it, carries none.
fn libstdcxx(out: &Path) -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-env-changed=CC");
    let native = std::env::var("HOST")? == std::env::var("TARGET")?;
    let compiler = std::env::var("CC").unwrap_or_else(|_| "cc".to_owned());
    let asked = Command::new(compiler).arg(format!("-print-file-name={LIBSTDCXX}")).output().ok();
    let found = asked.filter(|asked| native && asked.status.success()).and_then(|asked| {
        // One that it does not find it gives back without a folder.
        let path = PathBuf::from(String::from_utf8(asked.stdout).ok()?.trim());
        path.is_absolute().then(|| path.canonicalize().ok()).flatten()
    });
    let Some(library) = found else {
        println!("cargo::warning=built without {LIBSTDCXX}: a policy will need that of the machine it runs on");
        println!("cargo::rustc-env=RAPID_BUILT_WITH_CXX=none built in (a policy needs {LIBSTDCXX})");
        let none = out.join("libstdcxx-none.zst");
        std::fs::write(&none, [])?;
        println!("cargo::rustc-env=RAPID_LIBSTDCXX={}", none.display());
        return Ok(());
    };
    println!("cargo::rerun-if-changed={}", library.display());
    let name = library.file_name().unwrap_or_default().to_string_lossy().into_owned();
    println!("cargo::rustc-env=RAPID_BUILT_WITH_CXX={name} (built in)");
    println!("cargo::rustc-env=RAPID_LIBSTDCXX={}", pack(out, "libstdcxx", &std::fs::read(&library)?)?.display());
    Ok(())
}

/// A file with these bytes packed. They are packed once.
fn pack(out: &Path, name: &str, bytes: &[u8]) -> Result<PathBuf, Box<dyn Error>> {
    let packed = out.join(format!("{name}-{}-{LEVEL}.zst", sha256(bytes)));
    if !packed.exists() {
        let partial = packed.with_extension("partial");
        std::fs::write(&partial, zstd::bulk::compress(bytes, LEVEL)?)?;
        std::fs::rename(&partial, &packed)?;
    }
    Ok(packed)
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().fold(String::new(), |text, byte| format!("{text}{byte:02x}"))
}
