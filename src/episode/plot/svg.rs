//! Writes SVG: rectangles, lines, texts, pictures.
//!
//! Invariant: numbers are finite, and no text can end an element or an attribute.

use std::fmt::{self, Display, Write};

use rapid_core::text;

/// A document that grows.
#[derive(Debug, Default)]
pub(super) struct Svg(String);

/// Where a text is attached.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

/// A length or a place, with one decimal.
#[derive(Debug, Clone, Copy)]
pub(super) struct Px(pub(super) f64);

impl Display for Px {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let tenths = if self.0.is_finite() { (self.0 * 10.0).round() } else { 0.0 };
        // A negative zero is written as one.
        let value = tenths / 10.0 + 0.0;
        if tenths % 10.0 == 0.0 { write!(f, "{value:.0}") } else { write!(f, "{value:.1}") }
    }
}

/// Text within an element or a quoted attribute.
#[derive(Debug, Clone, Copy)]
struct Escaped<'a>(&'a str);

impl Display for Escaped<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for c in text::plain(self.0).chars() {
            match c {
                '&' => f.write_str("&amp;")?,
                '<' => f.write_str("&lt;")?,
                '>' => f.write_str("&gt;")?,
                '"' => f.write_str("&quot;")?,
                '\'' => f.write_str("&#39;")?,
                // These two are not characters of XML 1.0.
                '\u{fffe}' | '\u{ffff}' => f.write_char('\u{fffd}')?,
                c => f.write_char(c)?,
            }
        }
        Ok(())
    }
}

impl Svg {
    /// Writes what is formatted by this program, which needs no escape.
    pub(super) fn raw(&mut self, text: fmt::Arguments<'_>) {
        // Writing to a string cannot fail.
        let _ = self.0.write_fmt(text);
    }

    /// A rectangle of a class; `title` is shown when it is pointed at.
    pub(super) fn rect(&mut self, class: &str, [x, y, width, height]: [f64; 4], title: &str) {
        let (x, y, width, height) = (Px(x), Px(y), Px(width), Px(height));
        self.raw(format_args!("<rect class=\"{class}\" x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\""));
        self.end("rect", title);
    }

    /// A path of a class.
    pub(super) fn path(&mut self, class: &str, path: &str, title: &str) {
        if !path.is_empty() {
            self.raw(format_args!("<path class=\"{class}\" d=\"{path}\""));
            self.end("path", title);
        }
    }

    fn end(&mut self, element: &str, title: &str) {
        if title.is_empty() {
            self.raw(format_args!("/>\n"));
        } else {
            self.raw(format_args!("><title>{}</title></{element}>\n", Escaped(title)));
        }
    }

    /// A text of a class, whose baseline is at `y`.
    pub(super) fn text(&mut self, class: &str, x: f64, y: f64, anchor: Anchor, text: &str) {
        let anchor = match anchor {
            Anchor::Start => "",
            Anchor::Middle => " text-anchor=\"middle\"",
            Anchor::End => " text-anchor=\"end\"",
        };
        let (x, y, text) = (Px(x), Px(y), Escaped(text));
        self.raw(format_args!("<text class=\"{class}\" x=\"{x}\" y=\"{y}\"{anchor}>{text}</text>\n"));
    }

    /// A JPEG, which the document contains.
    pub(super) fn jpeg(&mut self, [x, y, width, height]: [f64; 4], jpeg: &[u8], title: &str) {
        let (x, y, width, height) = (Px(x), Px(y), Px(width), Px(height));
        self.raw(format_args!("<image x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" "));
        self.raw(format_args!(
            "preserveAspectRatio=\"xMidYMid meet\" href=\"data:image/jpeg;base64,{}\"",
            Base64(jpeg)
        ));
        self.end("image", title);
    }

    pub(super) fn finish(self) -> String {
        self.0
    }
}

/// Bytes as text (RFC 4648, section 4).
struct Base64<'a>(&'a [u8]);

impl Display for Base64<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
        for group in self.0.chunks(3) {
            let byte = |at: usize| group.get(at).copied().map_or(0, u32::from);
            let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
            for digit in 0..4 {
                let value = DIGITS.get((bits >> (18 - 6 * digit) & 63) as usize).copied().map_or('=', char::from);
                f.write_char(if digit > group.len() { '=' } else { value })?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_text_ends_an_element_or_leaves_xml() {
        let hostile = "a</text><script>\"'&\u{0}\u{1b}[2J\u{202e}\u{ffff}ü";
        let mut svg = Svg::default();
        svg.text("t", 1.0, 2.25, Anchor::End, hostile);
        svg.rect("r", [0.0, -0.01, f64::NAN, 3.0], hostile);
        let escaped = "a&lt;/text&gt;&lt;script&gt;&quot;&#39;&amp;  [2J \u{fffd}ü";
        assert_eq!(
            svg.finish(),
            format!(
                "<text class=\"t\" x=\"1\" y=\"2.3\" text-anchor=\"end\">{escaped}</text>\n\
                 <rect class=\"r\" x=\"0\" y=\"0\" width=\"0\" height=\"3\"><title>{escaped}</title></rect>\n"
            )
        );
    }

    #[test]
    fn base64_is_that_of_the_standard() {
        // RFC 4648, section 10.
        let table =
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foob", "Zm9vYg=="), ("fooba", "Zm9vYmE=")];
        for (text, encoded) in table {
            assert_eq!(Base64(text.as_bytes()).to_string(), encoded);
        }
        assert_eq!(Base64(&[0xfb, 0xff]).to_string(), "+/8=");
    }
}
