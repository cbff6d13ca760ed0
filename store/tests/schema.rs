//! Schemas as texts: what is read, what is refused and how the refusal reads, and values to JSON and back.
#![cfg(not(loom))]

use ddx_store::schema::{Encoding, Field, TEXT_MAX_BYTES, Type};
use ddx_store::{Item, Schema, Typed};
use proptest::prelude::*;
use serde_json::json;

const POSE: &str = r#"schema Pose plain struct size 24 {
  x: f64 @0 unit "m" range -10..10
  count: u64 @8
  wheels: [f32; 2] @16 range 0..0.1
}
"#;

fn fault(text: &str) -> String {
    match Schema::parse(text) {
        Ok(schema) => format!("no fault in {}", schema.text()),
        Err(fault) => fault.to_string(),
    }
}

#[test]
fn a_text_is_read_however_it_is_spaced_and_printed_in_one_way() {
    let loose = "schema  Pose plain struct size 24{x:f64@0 unit \"m\" range -10..10\r\n\r\n count : u64 @ 8 \
        wheels:[ f32;2 ]@16 range 0..0.1 }";

    assert_eq!(Schema::parse(loose).unwrap().text(), POSE);
    assert_eq!(Schema::parse(POSE).unwrap().size_bytes(), Some(24));
}

#[test]
fn a_schema_that_lies_about_its_size_is_refused() {
    let cases = [
        (
            "size 24",
            "size 16",
            "size 16 is stated, the fields end at 24",
        ),
        (
            "size 24",
            "size 32",
            "size 32 is stated, the fields end at 24",
        ),
        (
            "count: u64 @8",
            "count: u64 @4",
            "field `count`: offset 4 overlaps the field before, which ends at 8",
        ),
        (
            "count: u64 @8",
            "count: u64 @16",
            "field `count`: gap from 8 to 16: fill it with a field of u8",
        ),
        (
            "x: f64 @0",
            "x: f32 @0",
            "field `count`: gap from 4 to 8: fill it with a field of u8",
        ),
        (
            "wheels: [f32; 2]",
            "wheels: [f32; 400000000]",
            "field `wheels`: larger than 1073741824 bytes",
        ),
        (
            "wheels: [f32; 2]",
            "wheels: [f32; 0]",
            "field `wheels`: an array of no elements",
        ),
        (
            "count: u64 @8",
            "count: u64",
            "field `count`: a plain field must state its offset",
        ),
        ("count: u64", "x: u64", "`x` is there twice"),
        (
            "count: u64",
            "count: [u64]",
            "field `count`: [u64] has no fixed size: use the bincode encoding",
        ),
        (
            "count: u64",
            "count: bool",
            "field `count`: a bool is not valid under every bit pattern: use u8, or the bincode encoding",
        ),
    ];
    for (from, to, expected) in cases {
        assert_eq!(
            fault(&POSE.replace(from, to)),
            format!("schema `Pose`: {expected}")
        );
    }
    let unaligned = "schema P plain struct size 9 { a: u8 @0 b: u64 @1 }";
    assert_eq!(
        fault(unaligned),
        "schema `P`: field `b`: offset 1 is not a multiple of 8"
    );
    let ragged = "schema P plain struct size 9 { a: u64 @0 b: u8 @8 }";
    assert_eq!(
        fault(ragged),
        "schema `P`: size 9 is not a multiple of 8: add a last field of 7 u8"
    );
    let nested = "schema P plain struct size 8 { a: struct size 4 { b: u64 @0 } @0 }";
    assert_eq!(
        fault(nested),
        "schema `P`: field `a`: size 4 is stated, the fields end at 8"
    );
}

#[test]
fn a_fault_in_the_text_is_named_with_its_line() {
    let cases = [
        ("", "schema line 1: a word expected, the text ends"),
        (
            "shema P plain u8",
            "schema line 1: `schema` expected, `shema` found",
        ),
        (
            "schema P json u8",
            "schema line 1: `plain`, `bincode` or `raw` expected, `json` found",
        ),
        ("schema P plain\n\nu9", "schema line 3: `u9` is not a type"),
        (
            "schema P plain u8 u8",
            "schema line 1: the end of the text expected, 'u' found",
        ),
        (
            "schema P bincode struct {\n a: u8\n b u8\n}",
            "schema line 3: `:` expected, 'u' found",
        ),
        (
            "schema P bincode struct {\n a: u8 unit \"m\n}",
            "schema line 2: closing quote expected on the same line",
        ),
        (
            "schema P bincode struct { a: u8 range 5 }",
            "schema line 1: `5` is not a range",
        ),
        (
            "schema P bincode [u8; 03]",
            "schema line 1: `03` is not a number below 2^32",
        ),
        (
            "schema P bincode [u8; 4294967296]",
            "schema line 1: `4294967296` is not a number below 2^32",
        ),
        (
            "schema P bincode struct {\n a: u8\n",
            "schema line 3: a word expected, the text ends",
        ),
        (
            "schema P raw ros2msg\n| a\nb",
            "schema line 3: a line of foreign text begins with `| `",
        ),
    ];
    for (text, expected) in cases {
        assert_eq!(fault(text), expected, "{text:?}");
    }
}

#[test]
fn names_and_notes_have_rules() {
    let cases = [
        ("schema 7 plain u8", "schema `7`: a name is"),
        ("schema a..b plain u8", "schema `a..b`: a name is"),
        (
            "schema P bincode struct { a: string unit \"m\" }",
            "only a number has a unit or a range",
        ),
        (
            "schema P bincode struct { a: u8 range 2..1 }",
            "range 2..1 is empty",
        ),
        (
            "schema P bincode struct { a: u8 unit \"\" }",
            "a unit has 1 to 32 bytes",
        ),
        (
            "schema P bincode struct { a: u8 @0 }",
            "field `a`: bincode has no offsets",
        ),
        (
            "schema P bincode struct size 1 { a: u8 }",
            "a bincode struct has no size",
        ),
        ("schema P bincode struct { }", "a struct without fields"),
        (
            "schema P bincode option<option<u8>>",
            "an option in an option",
        ),
        ("schema P bincode enum { A, A }", "`A` is there twice"),
    ];
    for (text, expected) in cases {
        let fault = fault(text);
        assert!(fault.contains(expected), "{text}: {fault}");
    }
}

#[test]
fn size_depth_and_count_are_bounded() {
    let long = " ".repeat(TEXT_MAX_BYTES + 1);
    let deep = format!(
        "schema P bincode {}u8{}",
        "[".repeat(30_000),
        "]".repeat(30_000)
    );
    let options = format!("schema P bincode {}", "option<".repeat(9_000));
    let fields: String = (0..1025).map(|i| format!("f{i}: u8\n")).collect();
    let wide = format!("schema P bincode struct {{ {fields} }}");

    assert!(fault(&long).contains("the text has 65537 bytes"));
    assert_eq!(fault(&deep), "schema line 1: nested deeper than 16");
    assert_eq!(fault(&options), "schema line 1: nested deeper than 16");
    assert_eq!(fault(&wide), "schema `P`: more than 1024 fields");
}

#[test]
fn the_hash_covers_names_types_offsets_and_encoding_but_not_unit_and_range() {
    let hash = |text: &str| Schema::parse(text).unwrap().hash();
    let pose = hash(POSE);

    assert_eq!(pose, hash(&POSE.replace("unit \"m\" range -10..10", "")));
    assert_ne!(pose, hash(&POSE.replace("count", "counts")));
    assert_ne!(pose, hash(&POSE.replace("Pose", "Pos")));
    assert_ne!(pose, hash(&POSE.replace("u64", "i64")));
    assert_ne!(hash("schema P plain u8"), hash("schema P bincode u8"));
    // Golden: a change of the canonical text is a change of every schema in the field.
    assert_eq!(
        u64::schema().hash().to_string(),
        "f452ec6661d1f82fb33ccaa444fc0ebb"
    );
}

#[test]
fn the_first_difference_is_one_plain_sentence() {
    let pose = Schema::parse(POSE).unwrap();
    let cases = [
        ("Pose", "Pos", "the type is `Pose` here, `Pos` in the item"),
        (
            "count: u64",
            "count: f64",
            "field `count`: u64 here, f64 in the item",
        ),
        ("count", "counts", "field `count` is not in the item"),
        (
            "\"m\"",
            "\"km\"",
            "field `x`: unit `m` here, `km` in the item",
        ),
        (
            "-10..10",
            "..10",
            "field `x`: range -10..10 here, ..10 in the item",
        ),
        (
            "[f32; 2]",
            "[i32; 2]",
            "field `wheels[]`: f32 here, i32 in the item",
        ),
    ];
    for (from, to, expected) in cases {
        let item = Schema::parse(&POSE.replace(from, to)).unwrap();
        assert_eq!(pose.difference(&item).unwrap(), expected);
    }
    let swapped = "schema P bincode struct { b: u8 a: u8 }";
    let ordered = "schema P bincode struct { a: u8 b: u8 }";
    let [swapped, ordered] = [swapped, ordered].map(|text| Schema::parse(text).unwrap());
    assert_eq!(
        ordered.difference(&swapped).unwrap(),
        "field `a` stands where the item has `b`"
    );
    let longer = "schema P bincode struct { a: u8 b: struct { c: u8 d: u8 } }";
    let shorter = "schema P bincode struct { a: u8 b: struct { c: u8 } }";
    let [longer, shorter] = [longer, shorter].map(|text| Schema::parse(text).unwrap());
    assert_eq!(
        shorter.difference(&longer).unwrap(),
        "field `b.d` is only in the item"
    );
    assert_eq!(
        longer.difference(&shorter).unwrap(),
        "field `b.d` is not in the item"
    );
    assert_eq!(pose.difference(&Schema::parse(POSE).unwrap()), None);
}

#[test]
fn raw_schemas_differ_by_format_and_by_line() {
    let raw = |format, text| Schema::raw("Image", format, text).unwrap();
    let image = raw("ros2msg", "uint32 width\n\nuint32 height\n");

    assert_eq!(
        image.text(),
        "schema Image raw ros2msg\n| uint32 width\n|\n| uint32 height\n"
    );
    assert_eq!(Schema::parse(image.text()).unwrap(), image);
    assert_eq!(
        image.difference(&raw("protobuf", "")).unwrap(),
        "the format is ros2msg here, protobuf in the item"
    );
    assert_eq!(
        image
            .difference(&raw("ros2msg", "uint32 width\nx"))
            .unwrap(),
        "the foreign text differs from its line 2"
    );
    assert_eq!(
        image
            .difference(&Schema::new("Image", Encoding::Plain, u8::ty()).unwrap())
            .unwrap(),
        "the encoding is raw here, plain in the item"
    );
}

#[test]
fn json_goes_both_ways_in_the_order_of_the_fields() {
    let schema = Schema::parse(POSE).unwrap();
    let payload = schema
        .from_json(&json!({"wheels": [0.1, 0], "count": "18446744073709551615", "x": -2.5}))
        .unwrap();

    assert_eq!(payload.len(), 24);
    assert_eq!(
        schema.to_json(&payload).unwrap().to_string(),
        r#"{"x":-2.5,"count":"18446744073709551615","wheels":[0.1,0.0]}"#
    );
}

#[test]
fn a_value_that_does_not_fit_is_refused_by_the_path_of_its_field() {
    let text = "schema S bincode struct { a: [struct { b: option<i8> range -5..5 }] e: enum { On, Off } s: string }";
    let schema = Schema::parse(text).unwrap();
    let cases = [
        (
            json!({"a": [{"b": 1}, {"b": 6}], "e": "On", "s": ""}),
            "field `a[1].b`: 6 is out of range -5..5",
        ),
        (
            json!({"a": [{"b": 200}], "e": "On", "s": ""}),
            "field `a[0].b`: i8 expected, 200 found",
        ),
        (
            json!({"a": [{"b": 1.5}], "e": "On", "s": ""}),
            "field `a[0].b`: i8 expected, 1.5 found",
        ),
        (
            json!({"a": [{}], "e": "On", "s": ""}),
            "field `a[0].b` is missing",
        ),
        (
            json!({"a": [{"b": null, "c": 1}], "e": "On", "s": ""}),
            "field `a[0].c` is not in the schema",
        ),
        (
            json!({"a": {}, "e": "On", "s": ""}),
            "field `a`: [struct of 1 fields] expected, an object found",
        ),
        (
            json!({"a": [], "e": "Of", "s": ""}),
            "field `e`: enum { On, Off } expected, \"Of\" found",
        ),
        (
            json!({"a": [], "e": "On", "s": 7}),
            "field `s`: string expected, 7 found",
        ),
        (
            json!(7),
            "field `(value)`: struct of 3 fields expected, 7 found",
        ),
    ];
    for (value, expected) in cases {
        assert_eq!(schema.from_json(&value).unwrap_err().to_string(), expected);
    }
}

#[test]
fn a_payload_that_lies_about_a_length_costs_nothing() {
    let schema =
        Schema::parse("schema S bincode struct { a: [u8; 4000000000] b: [[u64]] }").unwrap();
    let list = Schema::scalar("[string]").unwrap();
    let lie = [253, 0xff, 0xff, 0xff, 0xff, 0xff, 0, 0, 0];

    assert_eq!(
        schema.to_json(&[0; 9]).unwrap_err().to_string(),
        "field `a[9]`: the payload ends here"
    );
    assert_eq!(
        list.to_json(&lie).unwrap_err().to_string(),
        "field `(value)`: length 1099511627775 is stated, 0 bytes are left"
    );
    assert_eq!(
        list.to_json(&[0, 0]).unwrap_err().to_string(),
        "field `(value)`: 1 bytes are left after the value"
    );
}

#[test]
fn json_loses_nothing() {
    let f64_schema = f64::schema();
    for bits in [
        f64::NAN.to_bits(),
        0x7ff8_0000_0000_0001,
        0xfff0_0000_0000_0001,
        f64::INFINITY.to_bits(),
        f64::NEG_INFINITY.to_bits(),
        (-0.0_f64).to_bits(),
        5e-324_f64.to_bits(),
        f64::MAX.to_bits(),
    ] {
        let json = f64_schema.to_json(&bits.to_le_bytes()).unwrap();
        let text = serde_json::to_string(&json).unwrap();
        let back = f64_schema.from_json(&serde_json::from_str(&text).unwrap());
        assert_eq!(back.unwrap(), bits.to_le_bytes(), "{text}");
    }
    let big = i64::schema().to_json(&i64::MIN.to_le_bytes()).unwrap();
    assert_eq!(big, json!("-9223372036854775808"));
    let edge = u64::schema().to_json(&(1_u64 << 53).to_le_bytes()).unwrap();
    assert_eq!(edge, json!(1_u64 << 53));
    assert_eq!(Schema::bytes().to_json(&[0, 255]).unwrap(), json!("AP8="));
    assert_eq!(Schema::bytes().from_json(&json!("AP8=")).unwrap(), [0, 255]);
    assert_eq!(
        Schema::json()
            .to_json(br#"{"b":1,"a":[]}"#)
            .unwrap()
            .to_string(),
        r#"{"b":1,"a":[]}"#
    );
    assert!(Schema::json().to_json(b"{").is_err());
}

#[test]
fn a_type_made_by_hand_obeys_the_same_rules() {
    let padded = Type::plain_struct(
        16,
        vec![
            Field::new("a", u8::ty()).at(0),
            Field::new("b", f64::ty()).at(8),
        ],
    );

    let fault = Schema::new("Padded", Encoding::Plain, padded.clone()).unwrap_err();
    assert_eq!(
        fault.to_string(),
        "schema `Padded`: field `b`: gap from 1 to 8: fill it with a field of u8"
    );
    let packed = Schema::new("Padded", Encoding::Bincode, padded).unwrap();
    assert_eq!(packed.size_bytes(), None);
}

proptest! {
    #[test]
    fn no_text_makes_the_reader_panic(text in "(schema|P|plain|bincode|raw|struct|size|enum|option|u8|f64|bool|[a-z0-9]|[\\[\\]{}<>:;,@|\"\n ]|unit|range|\\.\\.|-){0,60}") {
        let _unused = Schema::parse(&text);
        let _unused = Schema::scalar(&text);
    }

    #[test]
    fn damaged_texts_are_refused_or_canonical(at in any::<prop::sample::Index>(), with in "[ -~\n]{0,2}") {
        let at = at.index(POSE.len());
        let text = format!("{}{with}{}", &POSE[..at], &POSE[at + 1..]);
        if let Ok(schema) = Schema::parse(&text) {
            prop_assert_eq!(Schema::parse(schema.text()).unwrap(), schema);
        }
    }

    #[test]
    fn every_f32_survives_json(bits in any::<u32>()) {
        let json = f32::schema().to_json(&bits.to_le_bytes()).unwrap();
        let text = serde_json::to_string(&json).unwrap();
        let back = f32::schema().from_json(&serde_json::from_str(&text).unwrap()).unwrap();
        prop_assert_eq!(back, bits.to_le_bytes());
    }
}
