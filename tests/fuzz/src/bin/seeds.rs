//! Writes the plays from which the fuzzer starts: one for each kind of act, and a few that belong together.
//!
//! usage: cargo run --bin seeds -- DIRECTORY

use std::fs;
use std::path::Path;

fn main() -> std::io::Result<()> {
    let directory = std::env::args()
        .nth(1)
        .unwrap_or_else(|| "corpus".to_owned());
    for (target, name, play) in datagrams().into_iter().chain(requests()) {
        let directory = Path::new(&directory).join(target);
        fs::create_dir_all(&directory)?;
        fs::write(directory.join(name), play)?;
    }
    Ok(())
}

type Play = (&'static str, String, Vec<u8>);

fn datagrams() -> Vec<Play> {
    let mut plays: Vec<(String, Vec<u8>)> = Vec::new();
    let mut play = |name: &str, bytes: &[&[u8]]| plays.push((name.to_owned(), bytes.concat()));
    // Act 4 is a message of a member: how many entries, which kind, then what each kind takes.
    for kind in 0..18 {
        play(
            &format!("message-{kind}"),
            &[&[4, 3, kind], &[1; 60], &[0], &[8, 232, 3]],
        );
    }
    // Act 5 is a greeting: who, then what it says, then which kind.
    for kind in 0..4 {
        play(
            &format!("greeting-{kind}"),
            &[
                &[5, 2, 1, 0, 1, 1, 0, 29, 0, 7, 1, 1, kind, 1],
                &[8, 232, 3],
            ],
        );
    }
    let delta: &[u8] = &[4, 1, 5, 0, 1, 1, 1, 0, 1, 1, 8, 1, 0];
    let subscribe: &[u8] = &[4, 1, 8, 1, 4, 0, 0, 0, 0];
    let grant: &[u8] = &[4, 1, 9, 1, 1, 5, 1, 8, 0];
    let ack: &[u8] = &[4, 1, 13, 1, 1, 1, 0];
    let wait: &[u8] = &[8, 232, 3];
    let sample: &[u8] = &[6, 0, 5, 0, 1, 1, 0, 1, 1, 0, 3, 0, 7, 7, 7, 0, 0, 5, 1];
    let fragment: &[u8] = &[
        6, 0, 5, 0, 1, 2, 0, 1, 1, 1, 6, 0, 0, 0, 3, 0, 7, 7, 7, 0, 2, 5, 0,
    ];
    let rest: &[u8] = &[
        6, 0, 5, 0, 1, 2, 0, 1, 1, 1, 6, 0, 3, 0, 3, 0, 8, 8, 8, 0, 2, 5, 0,
    ];
    play(
        "owner",
        &[
            subscribe,
            &[15, 8, 0],
            wait,
            ack,
            &[15, 0, 9],
            wait,
            wait,
            wait,
            wait,
        ],
    );
    play(
        "reader",
        &[
            delta,
            wait,
            grant,
            sample,
            fragment,
            rest,
            &[10],
            wait,
            &[12, 0, 1],
            wait,
        ],
    );
    play(
        "damage",
        &[
            delta,
            &[13, 1, 30, 255, 0],
            sample,
            &[13, 0, 40, 1, 1],
            &[12, 0, 0],
        ],
    );
    play(
        "verbs",
        &[
            &[
                11, 0, 0, 11, 1, 4, 11, 2, 2, 11, 3, 0, 11, 4, 1, 14, 0, 5, 1, 1, 1,
            ],
            wait,
        ],
    );
    play(
        "raw",
        &[&[0, 3, 44, 0, 1, 1], &[0; 42], &[1, 44, 0, 1, 3], &[0; 42]],
    );
    play(
        "raw-behind-the-seal",
        &[&[
            2, 4, 0, 1, 2, 3, 4, 0, 3, 2, 0, 0, 0, 1, 7, 3, 0, 1, 2, 3, 0, 1, 0, 1,
        ]],
    );
    plays
        .into_iter()
        .map(|(name, play)| ("datagram", name, play))
        .collect()
}

fn requests() -> Vec<Play> {
    let mut plays: Vec<(String, Vec<u8>)> = Vec::new();
    let mut play = |name: &str, bytes: &[&[u8]]| plays.push((name.to_owned(), bytes.concat()));
    let connect: &[u8] = &[0, 1, 1, 0, b'p'];
    let open_writer: &[u8] = &[2, 0, 0, 1, 5, 0, 0, 0, 0, 0, 0];
    let read: &[u8] = &[2, 0, 0, 2, 6, 4, 0, 4, 1, 0, 0, 0, 0];
    let read_own: &[u8] = &[2, 0, 0, 2, 7, 4, 0, 0, 0, 0, 0, 0];
    // Descriptors: a good segment of the epoch that was given, then a commit of handle 5.
    let commit: &[u8] = &[2, 0, 132, 0, 8, 3, 7, 4, 3, 5, 2];
    // Act 2 is a request: who, what is beside it, its serial, its handle, its kind.
    for kind in 0..9 {
        play(
            &format!("request-{kind}"),
            &[connect, &[2, 0, 0, 1, 5, kind], &[0; 12], &[7, 10]],
        );
    }
    for kind in 128..134 {
        play(
            &format!("segment-{kind}"),
            &[
                connect,
                open_writer,
                &[2, 0, kind, 0, 8, 3, 7, 4],
                &[0, 1, 2, 1, 3, 5, 2],
            ],
        );
    }
    play(
        "life",
        &[
            connect,
            open_writer,
            commit,
            read_own,
            connect,
            read,
            &[8, 0, 0, 0, 7],
            &[6, 0],
            &[6, 0],
        ],
    );
    play(
        "put",
        &[
            connect,
            &[2, 0, 0, 1, 5, 0, 0, 0, 0, 0, 1],
            commit,
            &[2, 0, 0, 4, 5, 5, 2, 0, 0, 5, 5, 8, 0, 0],
        ],
    );
    play(
        "resume",
        &[
            connect,
            &[2, 0, 132, 255, 9, 8, 3, 7, 4, 3, 5, 3, 0, 0, 0, 0],
        ],
    );
    play(
        "remote",
        &[
            connect,
            read,
            &[9, 1, 3, 0, 4, 8, 1],
            &[b'p'; 64],
            &[0, 0],
            &[2, 0, 0, 1, 1, 7, 0, 4],
        ],
    );
    play(
        "garbage",
        &[connect, &[1, 0, 0, 4, 0, 1, 2, 3, 4], &[9, 0, 0]],
    );
    plays
        .into_iter()
        .map(|(name, play)| ("socket", name, play))
        .collect()
}
