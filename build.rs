//! Compiles each recorded schema to the `FileDescriptorSet` that MCAP wants beside the messages:
//! the schema's file and everything it imports. Says whether the library that policies need is at
//! hand.

use std::error::Error;
use std::path::PathBuf;

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

/// Where `make setup` has put the pinned onnxruntime library; the Makefile sets it.
const ONNXRUNTIME: &str = "RAPID_ONNXRUNTIME";

fn main() -> Result<(), Box<dyn Error>> {
    onnxruntime();
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

/// This version runs no policy and embeds nothing: it says what a build leaves out, so that nobody
/// who builds by hand is surprised later.
fn onnxruntime() {
    println!("cargo::rerun-if-env-changed={ONNXRUNTIME}");
    let found = std::env::var_os(ONNXRUNTIME).is_some_and(|path| PathBuf::from(path).is_file());
    let built_with = if found {
        "onnxruntime: at hand, not embedded (this version runs no policy)"
    } else {
        println!(
            "cargo::warning=built without onnxruntime, which `make setup` fetches: recording needs none, and \
             this version runs no policy"
        );
        "onnxruntime: left out (this version runs no policy)"
    };
    println!("cargo::rustc-env=RAPID_BUILT_WITH={built_with}");
}
