//! Tokens of an expression: names, numbers, strings and operators, each with its column.

use super::FilterError;

/// One token.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Token {
    pub column: usize,
    pub kind: TokenKind,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum TokenKind {
    Name(String),
    Int(i128),
    Float(f64),
    Text(String),
    Sign(&'static str),
    End,
}

/// Longest first: `<=` must not be read as `<` and `=`.
const SIGNS: [&str; 22] = [
    "**", "//", "<=", ">=", "==", "!=", "<", ">", "+", "-", "*", "/", "%", "(", ")", "[", "]", ",",
    ".", "=", ":", "{",
];

/// Returns all tokens, the last of which marks the end.
pub(super) fn tokens(text: &str) -> Result<Vec<Token>, FilterError> {
    let mut reader = Reader {
        rest: text,
        column: 1,
    };
    let mut tokens = Vec::new();
    loop {
        let blank = reader.rest.len() - reader.rest.trim_start().len();
        reader.take(blank);
        let column = reader.column;
        let Some(first) = reader.rest.chars().next() else {
            tokens.push(Token {
                column,
                kind: TokenKind::End,
            });
            return Ok(tokens);
        };
        let fraction = reader
            .rest
            .as_bytes()
            .get(1)
            .is_some_and(u8::is_ascii_digit);
        let kind = if first.is_ascii_alphabetic() || first == '_' {
            let end = reader
                .rest
                .find(|next: char| !next.is_ascii_alphanumeric() && next != '_');
            TokenKind::Name(reader.take(end.unwrap_or(reader.rest.len())).to_owned())
        } else if first.is_ascii_digit() || (first == '.' && fraction) {
            reader.number()?
        } else if first == '\'' || first == '"' {
            TokenKind::Text(reader.string(first)?)
        } else {
            let sign = SIGNS.iter().find(|sign| reader.rest.starts_with(**sign));
            let sign = *sign.ok_or_else(|| {
                FilterError::new(column, format!("`{first}` is not part of an expression"))
            })?;
            reader.take(sign.len());
            TokenKind::Sign(sign)
        };
        tokens.push(Token { column, kind });
    }
}

struct Reader<'a> {
    rest: &'a str,
    column: usize,
}

impl<'a> Reader<'a> {
    fn take(&mut self, length: usize) -> &'a str {
        let (taken, rest) = self
            .rest
            .split_at_checked(length)
            .unwrap_or((self.rest, ""));
        self.rest = rest;
        self.column += taken.chars().count();
        taken
    }

    fn number(&mut self) -> Result<TokenKind, FilterError> {
        let column = self.column;
        let wrong = || FilterError::new(column, "not a number");
        for (prefix, radix) in [("0x", 16), ("0b", 2), ("0o", 8)] {
            if self
                .rest
                .get(..2)
                .is_some_and(|start| start.eq_ignore_ascii_case(prefix))
            {
                self.take(2);
                let end = self
                    .rest
                    .find(|next: char| !next.is_ascii_alphanumeric() && next != '_');
                let digits = self.take(end.unwrap_or(self.rest.len())).replace('_', "");
                return i128::from_str_radix(&digits, radix)
                    .map(TokenKind::Int)
                    .map_err(|_| wrong());
            }
        }
        let mut previous = ' ';
        let end = self.rest.find(|next: char| {
            let sign = matches!(next, '+' | '-') && matches!(previous, 'e' | 'E');
            previous = next;
            !(sign || next.is_ascii_alphanumeric() || matches!(next, '.' | '_'))
        });
        let digits = self.take(end.unwrap_or(self.rest.len())).replace('_', "");
        if digits.bytes().all(|byte| byte.is_ascii_digit()) {
            return digits.parse().map(TokenKind::Int).map_err(|_| wrong());
        }
        let plain = digits
            .bytes()
            .all(|byte| b"0123456789.eE+-".contains(&byte));
        let number = digits.parse().ok().filter(|_| plain);
        number.map(TokenKind::Float).ok_or_else(wrong)
    }

    fn string(&mut self, quote: char) -> Result<String, FilterError> {
        let column = self.column;
        self.take(1);
        let mut text = String::new();
        loop {
            let Some(next) = self.rest.chars().next() else {
                return Err(FilterError::new(column, "unterminated string"));
            };
            self.take(next.len_utf8());
            if next == quote {
                return Ok(text);
            }
            if next != '\\' {
                text.push(next);
                continue;
            }
            let Some(escaped) = self.rest.chars().next() else {
                return Err(FilterError::new(column, "unterminated string"));
            };
            self.take(escaped.len_utf8());
            text.push(match escaped {
                'n' => '\n',
                't' => '\t',
                'r' => '\r',
                '0' => '\0',
                '\\' | '\'' | '"' => escaped,
                _ => {
                    let message = format!("the escape `\\{escaped}` is not supported");
                    return Err(FilterError::new(self.column - 2, message));
                }
            });
        }
    }
}
