//! Lists of texts and of numbers.

use toml::Spanned;
use toml::de::DeValue;

use super::{Problems, Section, as_i64};

impl Section<'_> {
    /// A list of texts.
    pub(in crate::registry) fn texts(&self, problems: &mut Problems<'_>, key: &str) -> Option<Vec<String>> {
        let text = |value: &DeValue<'_>| value.as_str().map(str::to_owned);
        self.list(problems, key, text, ("a list of texts", "write it as [\"a\", \"b\"]"))
    }

    /// A list of numbers.
    pub(in crate::registry) fn numbers(&self, problems: &mut Problems<'_>, key: &str) -> Option<Vec<f64>> {
        let number = |value: &DeValue<'_>| match value {
            DeValue::Integer(integer) => as_i64(integer).map(|number| number as f64),
            DeValue::Float(float) => float.as_str().replace('_', "").parse().ok(),
            _ => None,
        };
        self.list(problems, key, number, ("a list of numbers", "write it as [0, 1.5]"))
    }

    fn list<T>(
        &self,
        problems: &mut Problems<'_>,
        key: &str,
        item: impl Fn(&DeValue<'_>) -> Option<T>,
        (expected, fix): (&str, &str),
    ) -> Option<Vec<T>> {
        let value = self.field(key)?.get_ref();
        let array = value.as_array().map(|array| array.iter().map(Spanned::get_ref));
        let items = array.and_then(|array| array.map(item).collect::<Option<Vec<T>>>());
        if items.is_none() {
            self.wrong_type(problems, key, expected, fix);
        }
        items
    }
}
