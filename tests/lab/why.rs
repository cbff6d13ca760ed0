//! `ddx why` names the cause, each in one sentence.

use serde_json::Value;

use crate::program::NAME;
use crate::site::{PATIENCE, Site, wait};

#[test]
fn why_names_each_cause() {
    let Some(mut site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let mut robot = site.program("robot1");
    let mut mute = site.program("robot1");
    let mut reader = site.program("base");
    let mut patient = site.program("base");
    let mut misled = site.program("base");
    robot.open_writers("robot1/imu", 1);
    mute.open_writers("robot1/mute", 1);
    reader.open_readers("robot1/imu", 1);
    patient.open_readers("robot1/mute", 1);
    // It expects bytes, before there is anything.
    misled.open_readers("robot1/temperature", 1);
    let put = ["put", "robot1/temperature/0", "21.5", "--type", "f64"];
    site.ddx("robot1", &put);
    robot.write(1);
    reader.read(1, PATIENCE);

    site.wait_why(
        "base",
        "robot1/imu/0",
        "fine",
        &["all is well with `robot1/imu/0`", NAME],
    );
    site.wait_why(
        "base",
        "mars/imu/0",
        "no-such-name",
        &["no host `mars` is known"],
    );
    site.wait_why(
        "base",
        "robot1/imu/1",
        "no-such-name",
        &["host `robot1` is up and has no item `robot1/imu/1`"],
    );
    let nothing = format!("`{NAME}` has opened `robot1/mute/0` and written nothing yet");
    site.wait_why("base", "robot1/mute/0", "nothing-written", &[&nothing]);
    site.wait_why("robot1", "robot1/mute/0", "nothing-written", &[&nothing]);
    site.wait_why(
        "base",
        "robot1/temperature/0",
        "schema-mismatch",
        &["was refused", NAME, "f64"],
    );

    misled.kill();
    let unread = "nobody on this host reads `robot1/temperature/0`";
    site.wait_why("base", "robot1/temperature/0", "reader-gone", &[unread]);

    robot.kill();
    let orphaned = format!("`robot1/imu/0` has no writer: `{NAME}` is gone, the last value");
    site.wait_why("base", "robot1/imu/0", "no-writer", &[&orphaned]);
    site.wait_why("robot1", "robot1/imu/0", "no-writer", &[&orphaned]);

    site.lab.host("robot1").cut().unwrap();
    site.wait_why(
        "base",
        "robot1/imu/0",
        "host-unreachable",
        &["host `robot1` has been unreachable for"],
    );

    site.lab.host("robot1").heal().unwrap();
    site.wait_why("base", "robot1/imu/0", "no-writer", &[&orphaned]);
    site.terminate("robot1");
    site.wait_why(
        "base",
        "robot1/imu/0",
        "host-unreachable",
        &["host `robot1` left", "ago"],
    );

    site.terminate("base");
    site.up("base", &[]);
    site.wait_why(
        "base",
        "robot1/imu/0",
        "no-key",
        &["this host has no key, so that it does not see `robot1`"],
    );
}

impl Site {
    /// Waits until `ddx why` on a host gives this reason for an item, in a sentence that holds all of `parts`.
    #[track_caller]
    pub(crate) fn wait_why(&self, host: &str, item: &str, reason: &str, parts: &[&str]) {
        let what = format!("`ddx why {item}` on {host} to say {reason} with {parts:?}");
        wait(&what, PATIENCE, || {
            let said = self.ddx(host, &["why", item]);
            let [Value::Object(said)] = said.as_slice() else {
                return Err(format!("{said:?}"));
            };
            let sentence = said["sentence"].as_str().unwrap_or_default();
            let is_it =
                said["reason"] == reason && parts.iter().all(|part| sentence.contains(part));
            if is_it {
                Ok(())
            } else {
                Err(format!("{said:?}"))
            }
        });
    }
}
