//! The schemas of what is recorded, in the repository as they are compiled: a build needs no compiler for them.

use std::path::Path;

/// Set, the compiled schemas are written.
const WRITE: &str = "RAPID_WRITE_SCHEMAS";

const SCHEMAS: [&str; 13] = [
    "foxglove/CameraCalibration",
    "foxglove/CompressedImage",
    "foxglove/FrameTransform",
    "foxglove/JointStates",
    "foxglove/Log",
    "foxglove/PointCloud",
    "foxglove/PoseInFrame",
    "foxglove/RawImage",
    "rapid/Bytes",
    "rapid/Event",
    "rapid/Frame",
    "rapid/Mask",
    "rapid/Scalars",
];

#[test]
fn schemas_match_their_proto_files() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/episode/proto");
    for schema in SCHEMAS {
        let mut compiler = protox::Compiler::new([&folder]).expect("the folder");
        compiler.include_imports(true).include_source_info(false);
        compiler.open_file(format!("{schema}.proto")).unwrap_or_else(|error| panic!("{error:?}"));
        let descriptors = compiler.encode_file_descriptor_set();
        let file = folder.join(format!("{}.bin", schema.replace('/', ".")));
        if std::env::var_os(WRITE).is_some() {
            std::fs::write(&file, &descriptors).expect("written");
        }
        let again = format!("{WRITE}=1 make one TEST=schemas_match_their_proto_files");
        assert!(std::fs::read(&file).is_ok_and(|read| read == descriptors), "{} is old: {again}", file.display());
    }
    let files = std::fs::read_dir(&folder).expect("the folder").flatten();
    let written = files.filter(|file| file.path().extension().is_some_and(|extension| extension == "bin")).count();
    assert_eq!(written, SCHEMAS.len(), "a file of no schema in {}", folder.display());
}
