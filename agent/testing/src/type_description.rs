//! Responses of `type_description_interfaces/srv/GetTypeDescription`, encoded by hand after the
//! definitions of that package, as XCDR1 in little-endian order.

/// A `type_description_interfaces/msg/Field`.
#[derive(Clone, Debug, Default)]
pub struct Field {
    /// Name of the field.
    pub name: String,
    /// `FieldType.type_id`.
    pub type_id: u8,
    /// `FieldType.capacity`.
    pub capacity: u64,
    /// `FieldType.string_capacity`.
    pub string_capacity: u64,
    /// `FieldType.nested_type_name`.
    pub nested: String,
}

/// A `type_description_interfaces/msg/IndividualTypeDescription`.
#[derive(Clone, Debug, Default)]
pub struct Described {
    /// Name of the type.
    pub name: String,
    /// Its fields.
    pub fields: Vec<Field>,
}

/// A `type_description_interfaces/srv/GetTypeDescription_Response`.
#[derive(Clone, Debug, Default)]
pub struct Response {
    /// The requested type, then the types nested in it.
    pub types: Vec<Described>,
    /// Type, encoding and text of each file.
    pub sources: Vec<(String, String, String)>,
    /// Why the node does not know the type.
    pub failure: Option<String>,
}

/// Returns a field of a basic type.
#[must_use]
pub fn field(name: &str, type_id: u8) -> Field {
    Field {
        name: name.to_owned(),
        type_id,
        ..Field::default()
    }
}

/// Returns a field with a message, or with an array of messages.
#[must_use]
pub fn nested(name: &str, type_id: u8, nested: &str) -> Field {
    Field {
        nested: nested.to_owned(),
        ..field(name, type_id)
    }
}

/// Returns a type with these fields.
#[must_use]
pub fn described(name: &str, fields: &[Field]) -> Described {
    Described {
        name: name.to_owned(),
        fields: fields.to_vec(),
    }
}

impl Response {
    /// Returns a response without files.
    #[must_use]
    pub fn of(types: &[Described]) -> Self {
        Self {
            types: types.to_vec(),
            ..Self::default()
        }
    }

    /// Adds a file.
    #[must_use]
    pub fn with_source(mut self, name: &str, encoding: &str, text: &str) -> Self {
        let source = (name.to_owned(), encoding.to_owned(), text.to_owned());
        self.sources.push(source);
        self
    }

    /// Returns the payload, which begins with its encapsulation header.
    #[must_use]
    pub fn payload(&self) -> Vec<u8> {
        let mut cdr = Cdr::default();
        cdr.0.push(u8::from(self.failure.is_none()));
        cdr.text(self.failure.as_deref().unwrap_or_default());
        let empty = Described::default();
        cdr.described(self.types.first().unwrap_or(&empty));
        let nested = self.types.get(1..).unwrap_or_default();
        cdr.length(nested.len());
        nested.iter().for_each(|one| cdr.described(one));
        cdr.length(self.sources.len());
        for (name, encoding, text) in &self.sources {
            for text in [name, encoding, text] {
                cdr.text(text);
            }
        }
        // One entry of `extra_information`.
        cdr.length(1);
        cdr.text("key");
        cdr.text("value");
        [&[0, 1, 0, 0], &cdr.0[..]].concat()
    }
}

/// Bytes after the encapsulation header.
#[derive(Default)]
struct Cdr(Vec<u8>);

impl Cdr {
    fn align(&mut self, to: usize) {
        self.0.resize(self.0.len().next_multiple_of(to), 0);
    }

    fn length(&mut self, length: usize) {
        self.align(4);
        let length = u32::try_from(length).unwrap_or(u32::MAX);
        self.0.extend(length.to_le_bytes());
    }

    fn text(&mut self, text: &str) {
        self.length(text.len() + 1);
        self.0.extend(text.as_bytes());
        self.0.push(0);
    }

    fn described(&mut self, one: &Described) {
        self.text(&one.name);
        self.length(one.fields.len());
        for field in &one.fields {
            self.text(&field.name);
            self.0.push(field.type_id);
            for capacity in [field.capacity, field.string_capacity] {
                self.align(8);
                self.0.extend(capacity.to_le_bytes());
            }
            self.text(&field.nested);
            // The default value.
            self.text("");
        }
    }
}
