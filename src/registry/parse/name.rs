//! What entries and modules may be called.

/// In bytes.
const LONGEST_NAME: usize = 64;

/// Why `name` cannot be a modality's name, and what to do about it; `None` if it can.
#[must_use]
pub fn name_problem(name: &str) -> Option<(String, String)> {
    let begins = name.starts_with(|c: char| c.is_ascii_lowercase());
    if begins && name.len() <= LONGEST_NAME && name.chars().all(in_a_name) {
        return None;
    }
    let fix = match like_a_name(name) {
        Some(better) => {
            format!("use lower-case letters, digits and `_`, at most {LONGEST_NAME}, for example [device.{better}]")
        }
        None => {
            format!("begin with a lower-case letter; then lower-case letters, digits and `_`, at most {LONGEST_NAME}")
        }
    };
    Some((format!("{name:?} cannot be a modality's name"), fix))
}

/// The name that is nearest to any text, if one is near.
#[must_use]
pub fn like_a_name(text: &str) -> Option<String> {
    let better: String =
        text.to_lowercase().chars().map(|c| if in_a_name(c) { c } else { '_' }).take(LONGEST_NAME).collect();
    better.starts_with(|c: char| c.is_ascii_lowercase()).then_some(better)
}

const fn in_a_name(c: char) -> bool {
    c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_'
}
