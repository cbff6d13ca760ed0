//! The text of a schema: one canonical printer, and a strict reader for texts that anybody may have written.
//!
//! ```text
//! schema   = "schema" name ("plain" type | "bincode" type | "raw" format { newline "|" [" " text] })
//! type     = scalar | "string" | "bytes" | "[" type "]" | "[" type ";" count "]" | "option" "<" type ">"
//!          | "struct" ["size" bytes] "{" { field } "}" | "enum" "{" name { "," name } "}"
//! field    = name ":" type ["@" offset] ["unit" quoted] ["range" low ".." high]
//! ```

use super::check::{DEPTH_MAX, is_identifier};
use super::{Body, Field, Range, Scalar, Schema, SchemaError, Struct, TEXT_MAX_BYTES, Type};

/// Whether unit and range are printed: they are not part of a schema's identity.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Notes {
    With,
    Without,
}

/// Prints a schema in its one spelling.
pub(super) fn print(name: &str, body: &Body, notes: Notes) -> String {
    let mut out = format!("schema {name} ");
    match body {
        Body::Plain(ty) => {
            out.push_str("plain ");
            print_type(&mut out, ty, notes, 0);
        }
        Body::Bincode(ty) => {
            out.push_str("bincode ");
            print_type(&mut out, ty, notes, 0);
        }
        Body::Raw { format, text } => {
            out.push_str("raw ");
            out.push_str(format);
            let lines = text.split('\n').filter(|_line| !text.is_empty());
            for line in lines {
                out.push_str("\n|");
                if !line.is_empty() {
                    out.push(' ');
                    out.push_str(line);
                }
            }
        }
    }
    out.push('\n');
    out
}

/// Reads a whole schema.
pub(super) fn parse(text: &str) -> Result<Schema, SchemaError> {
    let mut parser = Parser::new(text)?;
    parser.keyword("schema")?;
    let name = parser.until_space();
    let body = match parser.word()? {
        "plain" => Body::Plain(parser.ty(0)?),
        "bincode" => Body::Bincode(parser.ty(0)?),
        "raw" => Body::Raw {
            format: parser.word()?.to_owned(),
            text: parser.foreign_lines()?,
        },
        other => {
            return Err(parser.fault(format!(
                "`plain`, `bincode` or `raw` expected, `{}` found",
                shortened(other)
            )));
        }
    };
    parser.end()?;
    Schema::checked(name, body)
}

/// Reads a type alone.
pub(super) fn parse_type(text: &str) -> Result<Type, SchemaError> {
    let mut parser = Parser::new(text)?;
    let ty = parser.ty(0)?;
    parser.end()?;
    Ok(ty)
}

fn print_type(out: &mut String, ty: &Type, notes: Notes, indent: usize) {
    match ty {
        Type::Scalar(_) | Type::String | Type::Bytes | Type::Enum(_) => {
            out.push_str(&ty.to_string());
        }
        Type::Array(element, count) => {
            out.push('[');
            print_type(out, element, notes, indent);
            out.push_str(&format!("; {count}]"));
        }
        Type::Vector(element) => {
            out.push('[');
            print_type(out, element, notes, indent);
            out.push(']');
        }
        Type::Option(value) => {
            out.push_str("option<");
            print_type(out, value, notes, indent);
            out.push('>');
        }
        Type::Struct(shape) => {
            out.push_str("struct ");
            if let Some(size) = shape.size_bytes {
                out.push_str(&format!("size {size} "));
            }
            out.push_str("{\n");
            for field in &shape.fields {
                print_field(out, field, notes, indent.saturating_add(INDENT));
            }
            out.push_str(&" ".repeat(indent));
            out.push('}');
        }
    }
}

fn print_field(out: &mut String, field: &Field, notes: Notes, indent: usize) {
    out.push_str(&" ".repeat(indent));
    out.push_str(&field.name);
    out.push_str(": ");
    print_type(out, &field.ty, notes, indent);
    if let Some(offset) = field.offset_bytes {
        out.push_str(&format!(" @{offset}"));
    }
    if notes == Notes::With {
        if let Some(unit) = &field.unit {
            out.push_str(&format!(" unit \"{unit}\""));
        }
        if let Some(range) = &field.range {
            out.push_str(&format!(" range {range}"));
        }
    }
    out.push('\n');
}

/// A cursor over the text that knows its line.
struct Parser<'a> {
    rest: &'a str,
    line: u32,
}

impl<'a> Parser<'a> {
    fn new(text: &'a str) -> Result<Self, SchemaError> {
        let parser = Self {
            rest: text,
            line: 1,
        };
        if text.len() > TEXT_MAX_BYTES {
            return Err(parser.fault(format!(
                "the text has {} bytes, at most {TEXT_MAX_BYTES} are read",
                text.len()
            )));
        }
        Ok(parser)
    }

    fn ty(&mut self, depth: u32) -> Result<Type, SchemaError> {
        if depth > DEPTH_MAX {
            return Err(self.fault(format!("nested deeper than {DEPTH_MAX}")));
        }
        let below = depth.saturating_add(1);
        if self.accept('[') {
            let element = self.ty(below)?;
            if self.accept(';') {
                let count = self.number()?;
                self.symbol(']')?;
                return Ok(Type::Array(Box::new(element), count));
            }
            self.symbol(']')?;
            return Ok(Type::vector(element));
        }
        match self.word()? {
            "string" => Ok(Type::String),
            "bytes" => Ok(Type::Bytes),
            "option" => {
                self.symbol('<')?;
                let value = self.ty(below)?;
                self.symbol('>')?;
                Ok(Type::option(value))
            }
            "struct" => self.structure(below),
            "enum" => self.names(),
            other => Scalar::from_name(other)
                .map(Type::Scalar)
                .ok_or_else(|| self.fault(format!("`{}` is not a type", shortened(other)))),
        }
    }

    fn structure(&mut self, depth: u32) -> Result<Type, SchemaError> {
        let size_bytes = if self.accept('{') {
            None
        } else {
            self.keyword("size")?;
            let size = self.number()?;
            self.symbol('{')?;
            Some(size)
        };
        let mut fields = Vec::new();
        while !self.accept('}') {
            fields.push(self.field(depth)?);
        }
        Ok(Type::Struct(Struct { fields, size_bytes }))
    }

    fn field(&mut self, depth: u32) -> Result<Field, SchemaError> {
        let name = self.name()?;
        self.symbol(':')?;
        let ty = self.ty(depth)?;
        let offset_bytes = if self.accept('@') {
            Some(self.number()?)
        } else {
            None
        };
        let unit = if self.accept_note("unit") {
            Some(self.quoted()?)
        } else {
            None
        };
        let range = if self.accept_note("range") {
            let text = self.until_space();
            let range = Range::parse(text);
            Some(range.ok_or_else(|| self.fault(format!("`{}` is not a range", shortened(text))))?)
        } else {
            None
        };
        Ok(Field {
            name,
            ty,
            offset_bytes,
            unit,
            range,
        })
    }

    fn names(&mut self) -> Result<Type, SchemaError> {
        self.symbol('{')?;
        let mut names = vec![self.name()?];
        while self.accept(',') {
            names.push(self.name()?);
        }
        self.symbol('}')?;
        Ok(Type::Enum(names))
    }

    /// The lines after the header of a raw schema, without their mark.
    fn foreign_lines(&mut self) -> Result<String, SchemaError> {
        self.skip_blanks();
        let Some(lines) = self.rest.strip_prefix('\n') else {
            return Ok(String::new());
        };
        self.rest = "";
        let mut text = Vec::new();
        for line in lines.lines() {
            self.line = self.line.saturating_add(1);
            let content = match line.strip_prefix('|') {
                Some("") => "",
                Some(marked) => marked
                    .strip_prefix(' ')
                    .ok_or_else(|| self.fault("a space is expected after `|`"))?,
                None => return Err(self.fault("a line of foreign text begins with `| `")),
            };
            text.push(content);
        }
        Ok(text.join("\n"))
    }

    fn name(&mut self) -> Result<String, SchemaError> {
        let word = self.word()?;
        if is_identifier(word) {
            return Ok(word.to_owned());
        }
        Err(self.fault(format!("`{}` is not a name", shortened(word))))
    }

    fn number(&mut self) -> Result<u32, SchemaError> {
        let word = self.word()?;
        let canonical = word == "0" || !word.starts_with('0');
        let number = word.parse().ok().filter(|_number: &u32| canonical);
        number
            .ok_or_else(|| self.fault(format!("`{}` is not a number below 2^32", shortened(word))))
    }

    fn quoted(&mut self) -> Result<String, SchemaError> {
        self.symbol('"')?;
        match self.rest.split_once('"') {
            Some((inside, rest)) if !inside.contains('\n') => {
                self.rest = rest;
                Ok(inside.to_owned())
            }
            Some(_) | None => Err(self.fault("closing quote expected on the same line")),
        }
    }

    fn keyword(&mut self, keyword: &str) -> Result<(), SchemaError> {
        match self.word()? {
            word if word == keyword => Ok(()),
            word => Err(self.fault(format!("`{keyword}` expected, `{}` found", shortened(word)))),
        }
    }

    /// Takes `unit` or `range` unless it is the name of the next field.
    fn accept_note(&mut self, note: &str) -> bool {
        self.skip_blanks();
        match self.rest.strip_prefix(note) {
            Some(rest) if rest.starts_with([' ', '\t']) && !rest.trim_start().starts_with(':') => {
                self.rest = rest;
                true
            }
            Some(_) | None => false,
        }
    }

    fn word(&mut self) -> Result<&'a str, SchemaError> {
        self.skip_space();
        let end = self
            .rest
            .find(|c: char| !c.is_ascii_alphanumeric() && c != '_')
            .unwrap_or(self.rest.len());
        let (word, rest) = self.rest.split_at(end);
        if word.is_empty() {
            return Err(self.unexpected("a word"));
        }
        self.rest = rest;
        Ok(word)
    }

    fn until_space(&mut self) -> &'a str {
        self.skip_blanks();
        let end = self
            .rest
            .find(char::is_whitespace)
            .unwrap_or(self.rest.len());
        let (word, rest) = self.rest.split_at(end);
        self.rest = rest;
        word
    }

    fn symbol(&mut self, symbol: char) -> Result<(), SchemaError> {
        if self.accept(symbol) {
            return Ok(());
        }
        Err(self.unexpected(&format!("`{symbol}`")))
    }

    fn accept(&mut self, symbol: char) -> bool {
        self.skip_space();
        match self.rest.strip_prefix(symbol) {
            Some(rest) => {
                self.rest = rest;
                true
            }
            None => false,
        }
    }

    fn end(&mut self) -> Result<(), SchemaError> {
        self.skip_space();
        if self.rest.is_empty() {
            return Ok(());
        }
        Err(self.unexpected("the end of the text"))
    }

    fn skip_blanks(&mut self) {
        self.rest = self.rest.trim_start_matches([' ', '\t', '\r']);
    }

    fn skip_space(&mut self) {
        loop {
            self.skip_blanks();
            match self.rest.strip_prefix('\n') {
                Some(rest) => {
                    self.rest = rest;
                    self.line = self.line.saturating_add(1);
                }
                None => return,
            }
        }
    }

    fn unexpected(&self, expected: &str) -> SchemaError {
        match self.rest.chars().next() {
            Some(found) => self.fault(format!("{expected} expected, {found:?} found")),
            None => self.fault(format!("{expected} expected, the text ends")),
        }
    }

    fn fault(&self, fault: impl Into<String>) -> SchemaError {
        SchemaError::Text {
            line: self.line,
            fault: fault.into(),
        }
    }
}

/// The start of a word, for an error message that hostile text cannot inflate.
fn shortened(word: &str) -> String {
    word.chars().take(40).collect()
}

/// Columns by which the fields of a struct stand to the right of it.
const INDENT: usize = 2;
