//! How much is done of a test that tries thousands of cases.

/// Of the cases of such a test every so manyth is tried: every `n`th, and with `RAPID_THOROUGH` (`make test-all`) each.
pub(crate) fn every(n: usize) -> usize {
    if is_thorough() { 1 } else { n }
}

/// Of the random cases of such a test a third, and with `RAPID_THOROUGH` all.
pub(crate) fn cases(all: u32) -> u32 {
    if is_thorough() { all } else { all / 3 }
}

fn is_thorough() -> bool {
    std::env::var_os("RAPID_THOROUGH").is_some()
}
