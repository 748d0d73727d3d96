//! Parses tokens into an expression, with Python's precedence.

use super::tokens::{Token, TokenKind};
use super::{Comparison, FilterError, Function, Kind, Method, Node, Operator};

/// Maximum depth of nested parentheses, lists and signs.
const MAX_DEPTH: usize = 32;

/// Parses all tokens as one expression.
pub(super) fn expression(tokens: &[Token]) -> Result<Node, FilterError> {
    let mut parser = Parser {
        tokens,
        position: 0,
        depth: 0,
    };
    let node = parser.or()?;
    match parser.peek() {
        TokenKind::End => Ok(node),
        TokenKind::Sign("=") => Err(parser.error("`=` assigns; `==` compares")),
        _ => Err(parser.error("expected an operator or the end")),
    }
}

struct Parser<'a> {
    tokens: &'a [Token],
    position: usize,
    depth: usize,
}

impl<'a> Parser<'a> {
    fn peek(&self) -> &'a TokenKind {
        self.tokens
            .get(self.position)
            .map_or(&TokenKind::End, |token| &token.kind)
    }

    fn column(&self) -> usize {
        self.tokens
            .get(self.position)
            .or(self.tokens.last())
            .map_or(1, |token| token.column)
    }

    fn error(&self, message: impl Into<String>) -> FilterError {
        FilterError::new(self.column(), message)
    }

    fn sign(&mut self, sign: &str) -> bool {
        let found = matches!(self.peek(), TokenKind::Sign(found) if *found == sign);
        self.position += usize::from(found);
        found
    }

    fn name(&mut self, name: &str) -> bool {
        let found = matches!(self.peek(), TokenKind::Name(found) if found == name);
        self.position += usize::from(found);
        found
    }

    fn expect(&mut self, sign: &str) -> Result<(), FilterError> {
        if self.sign(sign) {
            Ok(())
        } else {
            Err(self.error(format!("expected `{sign}`")))
        }
    }

    fn deeper<T>(
        &mut self,
        read: impl FnOnce(&mut Self) -> Result<T, FilterError>,
    ) -> Result<T, FilterError> {
        if self.depth == MAX_DEPTH {
            return Err(self.error(format!("nested deeper than {MAX_DEPTH} levels")));
        }
        self.depth += 1;
        let node = read(self);
        self.depth -= 1;
        node
    }

    fn or(&mut self) -> Result<Node, FilterError> {
        let mut left = self.and()?;
        while let column = self.column()
            && self.name("or")
        {
            let right = self.and()?;
            left = Node {
                column,
                kind: Kind::Or(Box::new(left), Box::new(right)),
            };
        }
        Ok(left)
    }

    fn and(&mut self) -> Result<Node, FilterError> {
        let mut left = self.not()?;
        while let column = self.column()
            && self.name("and")
        {
            let right = self.not()?;
            left = Node {
                column,
                kind: Kind::And(Box::new(left), Box::new(right)),
            };
        }
        Ok(left)
    }

    fn not(&mut self) -> Result<Node, FilterError> {
        let column = self.column();
        if self.name("not") {
            let inner = self.deeper(Self::not)?;
            return Ok(Node {
                column,
                kind: Kind::Not(Box::new(inner)),
            });
        }
        self.comparison()
    }

    fn comparison(&mut self) -> Result<Node, FilterError> {
        let column = self.column();
        let first = self.sum()?;
        let mut rest = Vec::new();
        while let Some(comparison) = self.comparison_sign()? {
            rest.push((comparison, self.sum()?));
        }
        if rest.is_empty() {
            return Ok(first);
        }
        Ok(Node {
            column,
            kind: Kind::Compare(Box::new(first), rest),
        })
    }

    fn comparison_sign(&mut self) -> Result<Option<Comparison>, FilterError> {
        let comparison = match self.peek() {
            TokenKind::Sign("<") => Comparison::Less,
            TokenKind::Sign("<=") => Comparison::LessOrEqual,
            TokenKind::Sign(">") => Comparison::Greater,
            TokenKind::Sign(">=") => Comparison::GreaterOrEqual,
            TokenKind::Sign("==") => Comparison::Equal,
            TokenKind::Sign("!=") => Comparison::NotEqual,
            TokenKind::Name(name) if name == "in" => Comparison::In,
            TokenKind::Name(name) if name == "not" => {
                self.position += 1;
                if !matches!(self.peek(), TokenKind::Name(name) if name == "in") {
                    return Err(self.error("expected `in` after `not`"));
                }
                Comparison::NotIn
            }
            _ => return Ok(None),
        };
        self.position += 1;
        Ok(Some(comparison))
    }

    fn sum(&mut self) -> Result<Node, FilterError> {
        let mut left = self.product()?;
        loop {
            let column = self.column();
            let operator = match self.peek() {
                TokenKind::Sign("+") => Operator::Add,
                TokenKind::Sign("-") => Operator::Subtract,
                _ => return Ok(left),
            };
            self.position += 1;
            let right = self.product()?;
            left = Node {
                column,
                kind: Kind::Binary(operator, Box::new(left), Box::new(right)),
            };
        }
    }

    fn product(&mut self) -> Result<Node, FilterError> {
        let mut left = self.signed()?;
        loop {
            let column = self.column();
            let operator = match self.peek() {
                TokenKind::Sign("*") => Operator::Multiply,
                TokenKind::Sign("/") => Operator::Divide,
                TokenKind::Sign("//") => Operator::FloorDivide,
                TokenKind::Sign("%") => Operator::Remainder,
                _ => return Ok(left),
            };
            self.position += 1;
            let right = self.signed()?;
            left = Node {
                column,
                kind: Kind::Binary(operator, Box::new(left), Box::new(right)),
            };
        }
    }

    fn signed(&mut self) -> Result<Node, FilterError> {
        let column = self.column();
        if self.sign("-") {
            let inner = self.deeper(Self::signed)?;
            return Ok(Node {
                column,
                kind: Kind::Negative(Box::new(inner)),
            });
        }
        if self.sign("+") {
            return self.deeper(Self::signed);
        }
        let base = self.postfix()?;
        let column = self.column();
        if !self.sign("**") {
            return Ok(base);
        }
        let exponent = self.deeper(Self::signed)?;
        Ok(Node {
            column,
            kind: Kind::Binary(Operator::Power, Box::new(base), Box::new(exponent)),
        })
    }

    fn postfix(&mut self) -> Result<Node, FilterError> {
        let mut node = self.atom()?;
        // Each attribute, call or index adds a level to the node.
        let mut steps = 0;
        loop {
            let column = self.column();
            steps += 1;
            if steps > MAX_DEPTH {
                return Err(self.error(format!("nested deeper than {MAX_DEPTH} levels")));
            }
            if self.sign(".") {
                let TokenKind::Name(name) = self.peek() else {
                    return Err(self.error("expected a field's name"));
                };
                self.position += 1;
                node = if self.sign("(") {
                    let method = Method::named(name).ok_or_else(|| {
                        FilterError::new(column + 1, format!("`{name}` cannot be called"))
                    })?;
                    let arguments = self.deeper(|parser| parser.list(")"))?;
                    Node {
                        column,
                        kind: Kind::Method(Box::new(node), method, arguments),
                    }
                } else {
                    Node {
                        column,
                        kind: Kind::Attribute(Box::new(node), name.clone()),
                    }
                };
            } else if self.sign("[") {
                let index = self.deeper(Self::or)?;
                if matches!(self.peek(), TokenKind::Sign(":")) {
                    return Err(self.error("slices are not supported"));
                }
                self.expect("]")?;
                node = Node {
                    column,
                    kind: Kind::Index(Box::new(node), Box::new(index)),
                };
            } else {
                return Ok(node);
            }
        }
    }

    /// Parses expressions up to the closing token.
    fn list(&mut self, end: &str) -> Result<Vec<Node>, FilterError> {
        let mut nodes = Vec::new();
        loop {
            if self.sign(end) {
                return Ok(nodes);
            }
            nodes.push(self.or()?);
            if !self.sign(",") {
                self.expect(end)?;
                return Ok(nodes);
            }
        }
    }

    fn atom(&mut self) -> Result<Node, FilterError> {
        let column = self.column();
        let token = self.peek();
        self.position += 1;
        let kind = match token {
            TokenKind::Int(number) => Kind::Int(*number),
            TokenKind::Float(number) => Kind::Float(*number),
            TokenKind::Text(text) => Kind::Text(text.clone()),
            TokenKind::Sign("[") => Kind::List(self.deeper(|parser| parser.list("]"))?),
            TokenKind::Sign("(") => return self.deeper(|parser| parser.parenthesis(column)),
            TokenKind::Name(name) => self.named(name, column)?,
            TokenKind::Sign(sign) => {
                return Err(FilterError::new(column, format!("unexpected `{sign}`")));
            }
            TokenKind::End => {
                return Err(FilterError::new(
                    column,
                    "expected a value: the expression ends",
                ));
            }
        };
        Ok(Node { column, kind })
    }

    /// Parses the content of parentheses, which is a list if it has a comma.
    fn parenthesis(&mut self, column: usize) -> Result<Node, FilterError> {
        if self.sign(")") {
            return Ok(Node {
                column,
                kind: Kind::List(Vec::new()),
            });
        }
        let first = self.or()?;
        if self.sign(",") {
            let mut nodes = vec![first];
            nodes.extend(self.list(")")?);
            return Ok(Node {
                column,
                kind: Kind::List(nodes),
            });
        }
        self.expect(")")?;
        Ok(first)
    }

    fn named(&mut self, name: &str, column: usize) -> Result<Kind, FilterError> {
        Ok(match name {
            "m" => Kind::Subject,
            "True" => Kind::Bool(true),
            "False" => Kind::Bool(false),
            "None" => Kind::None,
            _ => {
                let Some(function) = Function::named(name) else {
                    let known = Function::FUNCTION_NAMES.map(|(name, _)| name).join(", ");
                    let message =
                        format!("`{name}` is unknown; known are `m` (the message) and {known}");
                    return Err(FilterError::new(column, message));
                };
                self.expect("(")?;
                Kind::Call(function, self.deeper(|parser| parser.list(")"))?)
            }
        })
    }
}
