//! A reader of udev rules, written from udev(7) and apart from what writes them: what udev would see.

/// One `KEY{attribute}OPERATOR"value"`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Token {
    /// `ATTRS{serial}`.
    pub key: String,
    /// `==`, `!=`, `=`, `+=`, `-=` or `:=`.
    pub operator: &'static str,
    /// Between the quotes.
    pub value: String,
}

/// The rules of a file, each a list of tokens.
///
/// # Errors
/// Where udev would complain: the line.
pub fn parse(text: &str) -> Result<Vec<Vec<Token>>, String> {
    let mut rules = Vec::new();
    let mut continued = String::new();
    // udev ends lines at newlines alone, but what another reader takes for one must not be here.
    if let Some(odd) = text.chars().find(|c| *c != '\n' && !(' '..='~').contains(c)) {
        return Err(format!("{odd:?} in a rules file"));
    }
    for line in text.split('\n') {
        let line = line.trim_start();
        if continued.is_empty() && (line.is_empty() || line.starts_with('#')) {
            continue;
        }
        if let Some(begin) = line.strip_suffix('\\') {
            continued.push_str(begin);
            continue;
        }
        let line = std::mem::take(&mut continued) + line;
        rules.push(tokens(&line).ok_or(line)?);
    }
    if continued.is_empty() { Ok(rules) } else { Err(continued) }
}

fn tokens(line: &str) -> Option<Vec<Token>> {
    let mut tokens = Vec::new();
    let mut rest = line;
    loop {
        rest = rest.trim_start_matches([' ', '\t', ',']);
        if rest.is_empty() {
            return Some(tokens);
        }
        let end = rest.find(['=', '!', '+', '-', ':'])?;
        let key = rest[..end].trim_end().to_owned();
        let (name, _) = key.split_once('{').unwrap_or((&key, ""));
        if name.is_empty() || !name.chars().all(|c| c.is_ascii_uppercase()) {
            return None;
        }
        let operator = ["==", "!=", "+=", "-=", ":=", "="].into_iter().find(|op| rest[end..].starts_with(op))?;
        rest = rest[end + operator.len()..].trim_start().strip_prefix('"')?;
        let (value, after) = quoted(rest)?;
        tokens.push(Token { key, operator, value });
        rest = after;
    }
}

/// Up to the closing quote; `\"` stands for a quote.
fn quoted(text: &str) -> Option<(String, &str)> {
    let mut value = String::new();
    let mut chars = text.char_indices();
    while let Some((at, c)) = chars.next() {
        match c {
            '"' => return Some((value, &text[at + 1..])),
            '\\' if text[at + 1..].starts_with('"') => {
                chars.next();
                value.push('"');
            }
            c => value.push(c),
        }
    }
    None
}

/// Does udev's pattern match `text`? Shell globs as in fnmatch(3), alternatives parted by `|`.
#[must_use]
pub fn matches(pattern: &str, text: &str) -> bool {
    let text: Vec<char> = text.chars().collect();
    pattern.split('|').any(|alternative| glob(&alternative.chars().collect::<Vec<_>>(), &text))
}

fn glob(pattern: &[char], text: &[char]) -> bool {
    let Some((first, rest)) = pattern.split_first() else { return text.is_empty() };
    let one = |hit: bool, rest: &[char]| hit && glob(rest, &text[1..]);
    match first {
        '*' => (0..=text.len()).any(|taken| glob(rest, &text[taken..])),
        '?' => one(!text.is_empty(), rest),
        '[' => {
            let negated = rest.first() == Some(&'!');
            let set = if negated { &rest[1..] } else { rest };
            // A `]` that comes first is one of the set.
            let end = set.iter().skip(1).position(|c| *c == ']').map(|end| end + 1);
            match end {
                Some(end) => {
                    let hit = text.first().is_some_and(|c| within(&set[..end], *c) != negated);
                    one(hit, &set[end + 1..])
                }
                None => one(text.first() == Some(&'['), rest),
            }
        }
        c => one(text.first() == Some(c), rest),
    }
}

fn within(set: &[char], c: char) -> bool {
    let mut rest = set;
    while let Some((first, after)) = rest.split_first() {
        match after {
            ['-', last, tail @ ..] => {
                if (*first..=*last).contains(&c) {
                    return true;
                }
                rest = tail;
            }
            _ => {
                if *first == c {
                    return true;
                }
                rest = after;
            }
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rules_are_read_as_udev_reads_them() {
        let rules = parse("# a\nKERNEL==\"a\\\"b\", RUN+=\"x\"\n\n  SUBSYSTEM!=\"y\", \\\n ATTR{a}=\"z\"\n").unwrap();
        let reported: Vec<Vec<String>> = rules
            .iter()
            .map(|rule| rule.iter().map(|t| format!("{}{}{}", t.key, t.operator, t.value)).collect())
            .collect();
        assert_eq!(reported, [vec!["KERNEL==a\"b", "RUN+=x"], vec!["SUBSYSTEM!=y", "ATTR{a}=z"]]);
        for wrong in ["KERNEL==\"a", "KERNEL", "kernel==\"a\"", "KERNEL==a", "A==\"b\" \\", "A==\"\u{202e}\""] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn globs_match_as_in_a_shell() {
        for (pattern, text, expected) in [
            ("abc", "abc", true),
            ("a*c", "abbc", true),
            ("a?c", "ac", false),
            ("[*]", "*", true),
            ("[*]", "a", false),
            ("[[]", "[", true),
            ("[]]", "]", true),
            ("a|b", "b", true),
            ("[a-c]x", "bx", true),
            ("[!a]", "a", false),
        ] {
            assert_eq!(matches(pattern, text), expected, "{pattern} {text}");
        }
    }
}
