//! The derive: what a Rust type becomes, and that its bytes are those that its schema says.
#![cfg(not(loom))]

use ddx_store::{Encoding, Item, Plain, Schema};
use proptest::prelude::*;
use serde::{Deserialize, Serialize};

#[derive(Clone, Copy, Debug, PartialEq, Item)]
#[repr(C)]
struct Imu {
    #[ddx(unit = "m/s^2", range = "-160..160")]
    acceleration: [f32; 3],
    flags: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Item)]
#[repr(C)]
#[ddx(name = "robot.Pose")]
struct Pose {
    #[ddx(unit = "m", range = "-1e3..1000")]
    x: f64,
    imu: Imu,
    #[ddx(range = "0..")]
    r#type: u16,
    _pad: [u8; 6],
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, Item)]
#[ddx(encoding = "bincode")]
enum Mode {
    Idle,
    Drive,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, Item)]
#[repr(C)]
struct Cell {
    volts: f32,
    ordinal: u16,
    state: u16,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, Item)]
#[ddx(encoding = "bincode")]
#[serde(rename_all = "camelCase")]
struct Status {
    host_name: String,
    mode: Mode,
    ok: bool,
    counts: Vec<u64>,
    deltas: [i32; 3],
    tiny: i8,
    wide: Option<i64>,
    blob: Vec<u8>,
    cells: Vec<Cell>,
    shorts: Vec<Option<i16>>,
    ratio: f64,
    port: u16,
}

#[test]
fn a_plain_struct_prints_its_layout_units_and_ranges() {
    let schema = Pose::schema();

    assert_eq!(schema.encoding(), Encoding::Plain);
    assert_eq!(
        schema.text(),
        r#"schema robot.Pose plain struct size 32 {
  x: f64 @0 unit "m" range -1000.0..1000
  imu: struct size 16 {
    acceleration: [f32; 3] @0 unit "m/s^2" range -160..160
    flags: u32 @12
  } @8
  type: u16 @24 range 0..
  _pad: [u8; 6] @26
}
"#
    );
    assert_eq!(Schema::parse(schema.text()).unwrap(), schema);
}

#[test]
fn a_bincode_struct_has_no_offsets_even_around_a_plain_one() {
    let schema = Status::schema();

    assert_eq!(
        schema.text(),
        "schema Status bincode struct {
  host_name: string
  mode: enum { Idle, Drive }
  ok: bool
  counts: [u64]
  deltas: [i32; 3]
  tiny: i8
  wide: option<i64>
  blob: bytes
  cells: [struct {
    volts: f32
    ordinal: u16
    state: u16
  }]
  shorts: [option<i16>]
  ratio: f64
  port: u16
}
"
    );
    assert_eq!(Schema::parse(schema.text()).unwrap(), schema);
}

#[test]
fn scalars_agree_with_what_a_person_types() {
    assert_eq!(Schema::scalar("u64").unwrap(), u64::schema());
    assert_eq!(Schema::scalar(" [f32;3] ").unwrap(), <[f32; 3]>::schema());
    assert_eq!(Schema::scalar("string").unwrap(), String::schema());
    assert_eq!(Schema::scalar("bool").unwrap(), bool::schema());
    assert_eq!(Schema::scalar("bytes").unwrap(), Vec::<u8>::schema());
    assert_eq!(
        Schema::scalar(Pose::schema().text()).unwrap(),
        Pose::schema()
    );
}

#[test]
fn plain_types_can_be_read_in_place() {
    fn is_plain<T: Plain>() {}
    is_plain::<Pose>();
    is_plain::<[Imu; 4]>();
}

proptest! {
    #[test]
    fn plain_values_survive_json_bit_for_bit(bytes in any::<[u8; 32]>()) {
        let pose = Pose::decode(&bytes).unwrap();
        let json = Pose::schema().to_json(&bytes).unwrap();
        // NaN and values out of range are what a person may read but not put.
        let text = serde_json::to_string(&json).unwrap();
        let without_ranges = Schema::parse(&unranged(Pose::schema().text())).unwrap();
        let back = without_ranges.from_json(&serde_json::from_str(&text).unwrap()).unwrap();
        let mut encoded = Vec::new();
        pose.encode(&mut encoded).unwrap();

        prop_assert_eq!(&back, &bytes);
        prop_assert_eq!(&encoded, &bytes);
    }

    #[test]
    fn our_bincode_is_that_of_bincode_byte_for_byte(status in statuses()) {
        let mut encoded = Vec::new();
        status.encode(&mut encoded).unwrap();
        let json = Status::schema().to_json(&encoded).unwrap();
        let text = serde_json::to_string(&json).unwrap();
        let ours = Status::schema().from_json(&serde_json::from_str(&text).unwrap()).unwrap();

        prop_assert_eq!(&ours, &encoded);
        prop_assert_eq!(&json["host_name"], &status.host_name);
        prop_assert_eq!(json["shorts"].as_array().unwrap().len(), status.shorts.len());
        let decoded = Status::decode(&ours).unwrap();
        prop_assert_eq!(decoded.ratio.to_bits(), status.ratio.to_bits());
        prop_assert_eq!(Status { ratio: 0.0, ..decoded }, Status { ratio: 0.0, ..status });
    }

    #[test]
    fn both_decoders_agree_on_what_is_no_status(bytes in damaged()) {
        let theirs = Status::decode(&bytes);
        let ours = Status::schema().to_json(&bytes);

        prop_assert_eq!(theirs.is_ok(), ours.is_ok(), "{:?} {:?}", theirs, ours);
    }
}

/// Payloads with one byte changed and the end cut off or not.
fn damaged() -> impl Strategy<Value = Vec<u8>> {
    (
        statuses(),
        any::<prop::sample::Index>(),
        any::<u8>(),
        0_usize..3,
    )
        .prop_map(|(status, at, value, cut)| {
            let mut bytes = Vec::new();
            assert!(status.encode(&mut bytes).is_ok());
            let at = at.index(bytes.len());
            bytes[at] = value;
            bytes.truncate(bytes.len() - cut);
            bytes
        })
}

fn statuses() -> impl Strategy<Value = Status> {
    let wide = prop_oneof![
        any::<u64>(),
        0_u64..300,
        Just(250),
        Just(251),
        Just(u64::from(u16::MAX)),
        Just(u64::from(u32::MAX) + 1)
    ];
    let lists = (
        prop::collection::vec(wide, 0..5),
        prop::collection::vec(any::<u8>(), 0..300),
        prop::collection::vec(any::<Option<i16>>(), 0..5),
        prop::collection::vec((-1e3_f32..1e3, any::<u16>(), any::<u16>()), 0..4),
    );
    let rest = (
        ".{0,12}",
        any::<bool>(),
        any::<[i32; 3]>(),
        any::<i8>(),
        any::<Option<i64>>(),
        any::<f64>(),
        any::<u16>(),
    );
    (lists, rest).prop_map(
        |((counts, blob, shorts, cells), (host_name, ok, deltas, tiny, wide, ratio, port))| {
            Status {
                host_name,
                mode: if ok { Mode::Drive } else { Mode::Idle },
                ok,
                counts,
                deltas,
                tiny,
                wide,
                blob,
                cells: cells
                    .into_iter()
                    .map(|(volts, ordinal, state)| Cell {
                        volts,
                        ordinal,
                        state,
                    })
                    .collect(),
                shorts,
                ratio,
                port,
            }
        },
    )
}

fn unranged(text: &str) -> String {
    text.lines()
        .map(|line| line.split(" range ").next().unwrap_or_default())
        .collect::<Vec<_>>()
        .join("\n")
}
