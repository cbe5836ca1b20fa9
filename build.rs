//! Compiles each recorded schema to the `FileDescriptorSet` that MCAP wants beside the messages:
//! the schema's file and everything it imports.

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

fn main() -> Result<(), Box<dyn Error>> {
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
