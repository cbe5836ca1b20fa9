//! Types whose values have names in files and on the command line: one table for reading and writing.

/// Gives a type the words for its values: a table for the parser, the word of a value, and `Display` with that word.
#[macro_export]
macro_rules! words {
    ($($(#[$doc:meta])* $type:ident, $count:literal: $($word:literal = $value:ident),+ $(; $more:literal = $other:ident)?;)+) => {$(
        impl $type {
            $(#[$doc])*
            pub const WORDS: [(&str, Self); $count] = [$(($word, Self::$value)),+];

            /// The word for it.
            pub const fn word(self) -> &'static str {
                match self {
                    $(Self::$value => $word,)+
                    $(Self::$other => $more,)?
                }
            }
        }

        impl ::std::fmt::Display for $type {
            fn fmt(&self, f: &mut ::std::fmt::Formatter<'_>) -> ::std::fmt::Result {
                f.write_str(self.word())
            }
        }
    )+};
}
