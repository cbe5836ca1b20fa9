//! libFuzzer on the target named in `FUZZ_TARGET`: one program, because linking one a target takes
//! longer than building them. `scripts/fuzz.sh` builds and runs it.

#![no_main]

use std::sync::LazyLock;

use fuzz::Target;
use libfuzzer_sys::fuzz_target;

static TARGET: LazyLock<&'static Target> = LazyLock::new(|| {
    let name = std::env::var("FUZZ_TARGET").unwrap_or_default();
    fuzz::target(&name).unwrap_or_else(|| panic!("FUZZ_TARGET={name:?} names no target"))
});

fuzz_target!(|bytes: &[u8]| (TARGET.run)(bytes));
