//! The arrows between the rooms, and the rules that no compiler knows, read from the manifests and the sources.

#![expect(
    clippy::unwrap_used,
    reason = "a helper of a test fails the test, as the test itself would"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use toml::{Table, Value};

/// What each crate may name, apart from what its tests name.
const ARROWS: &[(&str, &[&str])] = &[
    (
        "ddx",
        &["ddx-catalog", "ddx-store", "ddx-video", "ddx-wire"],
    ),
    (
        "ddx-bench",
        &[
            "ddx",
            "ddx-catalog",
            "ddx-rig",
            "ddx-store",
            "ddx-video",
            "ddx-wire",
        ],
    ),
    ("ddx-catalog", &["ddx-wire"]),
    ("ddx-derive", &[]),
    (
        "ddx-rig",
        &["ddx", "ddx-catalog", "ddx-store", "ddx-video", "ddx-wire"],
    ),
    ("ddx-store", &["ddx-derive", "ddx-wire"]),
    ("ddx-video", &["ddx-wire"]),
    ("ddx-wire", &[]),
];

/// The rooms that read no clock, draw no randomness, open nothing and spawn nothing.
const PURE_ROOMS: &[&str] = &["catalog", "video"];

/// How a pure room would get at the world without being handed it.
const IMPURE: &[&str] = &[
    "Instant::now",
    "SystemTime::now",
    "thread::spawn",
    "thread::sleep",
    "std::fs",
    "std::env",
    "UdpSocket",
    "TcpStream",
    "HashMap",
    "HashSet",
    "SystemRandom",
    "libc::",
    "tokio::",
];

/// The number of `.expect(` outside of tests; it may only fall.
const EXPECT_BUDGET: &str = "tests/expect-budget";

#[test]
fn every_crate_names_only_the_rooms_that_its_arrows_allow() {
    let arrows: BTreeMap<&str, BTreeSet<&str>> = ARROWS
        .iter()
        .map(|(name, allowed)| (*name, allowed.iter().copied().collect()))
        .collect();

    let mut wrong = Vec::new();
    for manifest in manifests() {
        let allowed = arrows.get(manifest.name.as_str());
        let Some(allowed) = allowed else {
            wrong.push(format!("{} has no line in ARROWS", manifest.name));
            continue;
        };
        for named in manifest
            .dependencies
            .iter()
            .filter(|named| arrows.contains_key(named.as_str()))
        {
            if !allowed.contains(named.as_str()) {
                wrong.push(format!("{} names {named}", manifest.name));
            }
        }
    }

    assert_eq!(wrong, Vec::<String>::new());
}

#[test]
fn store_catalog_and_video_never_name_one_another_not_even_in_tests() {
    let rooms = ["ddx-store", "ddx-catalog", "ddx-video"];
    for manifest in manifests()
        .into_iter()
        .filter(|manifest| rooms.contains(&manifest.name.as_str()))
    {
        for other in rooms.iter().filter(|other| **other != manifest.name) {
            assert!(!manifest.names(other), "{} names {other}", manifest.name);
        }
    }
}

#[test]
fn nothing_but_tests_sees_the_rig() {
    for manifest in manifests() {
        let is_test = manifest.path.starts_with("tests");
        assert!(
            is_test || !manifest.dependencies.contains("ddx-rig"),
            "{} names ddx-rig",
            manifest.name
        );
    }
}

#[test]
fn bincode_has_one_home_and_tokio_stays_where_the_rooms_meet() {
    for manifest in manifests() {
        let depends = |on: &str| manifest.dependencies.contains(on);
        assert!(
            manifest.name == "ddx-wire" || !depends("bincode"),
            "{} names bincode",
            manifest.name
        );
        let may_have_tokio = manifest.name == "ddx" || manifest.path.starts_with("tests");
        assert!(
            may_have_tokio || !manifest.names("tokio"),
            "{} names tokio",
            manifest.name
        );
    }
}

#[test]
fn only_the_codec_says_bincode() {
    let said_in: Vec<String> = sources(&["src", "catalog", "store", "video"])
        .into_iter()
        .filter(|source| source.code.contains("bincode::"))
        .map(|source| source.path)
        .collect();

    assert_eq!(said_in, ["catalog/wire/src/codec.rs"]);
}

#[test]
fn pure_rooms_are_handed_the_world_and_never_reach_for_it() {
    let mut wrong = Vec::new();
    for source in sources(PURE_ROOMS) {
        for word in IMPURE {
            for line in source
                .code
                .lines()
                .filter(|line| line.contains(word) && !line.trim_start().starts_with("//"))
            {
                wrong.push(format!("{}: {}", source.path, line.trim()));
            }
        }
    }

    assert_eq!(wrong, Vec::<String>::new());
}

#[test]
fn every_crate_takes_the_one_lint_table() {
    for manifest in manifests() {
        let takes = manifest
            .table
            .get("lints")
            .and_then(|lints| lints.get("workspace"))
            == Some(&Value::Boolean(true));
        assert!(takes, "{} has no `[lints] workspace = true`", manifest.name);
    }
}

#[test]
fn a_module_is_named_like_its_file() {
    let named: Vec<PathBuf> = rust_files(&["src", "catalog", "store", "tests", "video"])
        .into_iter()
        .filter(|path| path.ends_with("mod.rs"))
        .collect();

    assert_eq!(named, Vec::<PathBuf>::new());
}

#[test]
fn the_number_of_expects_outside_of_tests_only_falls() {
    let budget: usize = read(&root().join(EXPECT_BUDGET)).trim().parse().unwrap();
    let counts: BTreeMap<String, usize> = sources(&["src", "catalog", "store", "video"])
        .into_iter()
        .map(|source| (source.path, source.code.matches(".expect(").count()))
        .filter(|(_, count)| *count > 0)
        .collect();
    let count: usize = counts.values().sum();

    assert!(
        count <= budget,
        "{count} `.expect(` where {EXPECT_BUDGET} allows {budget}: return an error\n{counts:#?}"
    );
    assert!(
        count == budget,
        "only {count} `.expect(` are left: write that into {EXPECT_BUDGET}, so that it stays so"
    );
}

#[test]
fn the_rules_see_through_comments_and_tests() {
    let text = "//! bincode::a\nfn f() {}\n#[cfg(all(test, not(loom)))]\nmod tests {\n    use bincode::b;\n}\n";

    assert_eq!(without_tests(text), "//! bincode::a\nfn f() {}\n");
    assert_eq!(
        without_tests("#[cfg(test)]\nuse a;\nfn g() {}\n"),
        "#[cfg(test)]\nuse a;\nfn g() {}\n"
    );
}

/// One crate of the workspace.
struct Manifest {
    name: String,
    /// Directory, relative to the root.
    path: PathBuf,
    table: Table,
    dependencies: BTreeSet<String>,
    test_dependencies: BTreeSet<String>,
}

impl Manifest {
    fn names(&self, other: &str) -> bool {
        self.dependencies.contains(other) || self.test_dependencies.contains(other)
    }
}

/// One file of a room, without its tests.
struct Source {
    path: String,
    code: String,
}

fn manifests() -> Vec<Manifest> {
    let workspace: Table = read(&root().join("Cargo.toml")).parse().unwrap();
    let members = workspace["workspace"]["members"].as_array().unwrap();
    members
        .iter()
        .map(|member| manifest(Path::new(member.as_str().unwrap())))
        .collect()
}

fn manifest(path: &Path) -> Manifest {
    let table: Table = read(&root().join(path).join("Cargo.toml")).parse().unwrap();
    let mut dependencies = BTreeSet::new();
    let mut test_dependencies = BTreeSet::new();
    let targets = table.get("target").and_then(Value::as_table);
    let conditional = targets
        .into_iter()
        .flat_map(Table::values)
        .filter_map(Value::as_table);
    for section in [&table].into_iter().chain(conditional) {
        for kind in ["dependencies", "build-dependencies"] {
            dependencies.extend(named_in(section, kind));
        }
        test_dependencies.extend(named_in(section, "dev-dependencies"));
    }
    let name = table["package"]["name"].as_str().unwrap().to_owned();
    Manifest {
        name,
        path: path.to_owned(),
        table,
        dependencies,
        test_dependencies,
    }
}

/// Returns the packages in one dependency table, by their own names where they were renamed.
fn named_in(section: &Table, kind: &str) -> BTreeSet<String> {
    let table = section.get(kind).and_then(Value::as_table);
    let entries = table.into_iter().flat_map(Table::iter);
    entries
        .map(|(key, value)| {
            value
                .get("package")
                .and_then(Value::as_str)
                .unwrap_or(key)
                .to_owned()
        })
        .collect()
}

fn sources(rooms: &[&str]) -> Vec<Source> {
    rust_files(rooms)
        .into_iter()
        .filter(|path| {
            !path
                .iter()
                .any(|part| part == "tests" || part == "tests.rs")
        })
        .map(|path| Source {
            code: without_tests(&read(&root().join(&path))).to_owned(),
            path: path.to_string_lossy().into_owned(),
        })
        .collect()
}

/// Returns the Rust files below these directories in order, relative to the root.
fn rust_files(rooms: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut directories: Vec<PathBuf> = rooms.iter().map(PathBuf::from).collect();
    while let Some(directory) = directories.pop() {
        for entry in fs::read_dir(root().join(&directory)).unwrap() {
            let entry = entry.unwrap();
            let path = directory.join(entry.file_name());
            if entry.file_type().unwrap().is_dir() {
                if !path.ends_with("target") {
                    directories.push(path);
                }
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                found.push(path);
            }
        }
    }
    found.sort();
    assert!(
        !found.is_empty(),
        "no source below {rooms:?}: the rules would hold for nothing"
    );
    found
}

/// Cuts a file before its test module, which the house keeps last.
fn without_tests(text: &str) -> &str {
    let mut begins = 0;
    let mut lines = text.split_inclusive('\n').peekable();
    while let Some(line) = lines.next() {
        let is_attribute = line.starts_with("#[cfg(") && line.contains("test");
        if is_attribute && lines.peek().is_some_and(|next| next.starts_with("mod ")) {
            return &text[..begins];
        }
        begins += line.len();
    }
    text
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}
