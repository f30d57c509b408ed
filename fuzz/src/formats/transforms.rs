//! Captures in `transforms.json`, and Blender's in `transforms_train.json`.

use std::sync::Arc;

use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use serde_json::{Value, json};
use splat_data::capture::in_memory::parse_transforms;
use splat_trainer::TrainSettings;

use super::{Follow, Input, Memory, Target, mutate_json, train_steps};
use crate::mutate::{self, one_of, place};

/// An input has two parts: the file, and the end of its name without its ending.
pub(super) const TARGET: Target = Target {
    name: "transforms",
    file: "transforms",
    seeds,
    mutate,
    parse,
    follow_every: 64,
    // The JSON library makes room for eleven entries in every object.
    memory: Memory {
        per_byte: 128,
        constant: 8 << 10,
    },
};

/// Keys, and values that mean something.
const WORDS: [&str; 36] = [
    "\"camera_model\": \"OPENCV_FISHEYE\",",
    "\"camera_model\": \"EQUIRECTANGULAR\",",
    "\"is_fisheye\": true,",
    "\"fl_x\": 20,",
    "\"fl_y\": 1e300,",
    "\"camera_angle_x\": 0.7,",
    "\"camera_angle_y\": 3.2,",
    "\"cx\": -1e300,",
    "\"cy\": 4,",
    "\"w\": 24,",
    "\"h\": 4294967296,",
    "\"k1\": -0.1,",
    "\"k2\": 1e30,",
    "\"k3\": 0.01,",
    "\"k4\": 0.01,",
    "\"p1\": 1e-3,",
    "\"p2\": 0,",
    "\"distortion_params\": [1, 2, 3],",
    "\"frames\": [],",
    "\"train_filenames\": [\"images/0.png\"],",
    "\"val_filenames\": [\"images/9.png\"],",
    "\"test_filenames\": [\"./images/0.png\", \"../0.png\"],",
    "\"mask_path\": \"masks/0.png\",",
    "\"depth_file_path\": \"depth/0.png\",",
    "\"ply_file_path\": \"points.ply\",",
    "\"file_path\": \"../images/0.png\",",
    "\"file_path\": \"/images/0.png\",",
    "\"file_path\": \"a\\\\b.png\",",
    "\"file_path\": \"..\",",
    "\"applied_scale\": 0,",
    "1e999",
    "[[[[[[[[[[[[[[[[",
    "null",
    "-0.0",
    "{}",
    "[]",
];

fn seeds() -> Vec<Input> {
    let pose = |i: u32| {
        let (s, c) = (0.4 * f64::from(i)).sin_cos();
        json!([
            [c, 0, s, 4.0 * s],
            [0, 1, 0, 0],
            [-s, 0, c, 4.0 * c],
            [0, 0, 0, 1]
        ])
    };
    let frames = |folder: &str, ending: &str| -> Value {
        let frame = |i: u32| {
            json!({
                "file_path": format!("{folder}/{i}{ending}"),
                "transform_matrix": pose(i),
            })
        };
        (0..4).map(frame).collect::<Vec<_>>().into()
    };
    let mut nerfstudio = json!({
        "camera_model": "OPENCV",
        "fl_x": 30.0, "fl_y": 31.0, "cx": 12.0, "cy": 9.0, "w": 24, "h": 18,
        "k1": -0.1, "k2": 0.01, "p1": 1e-3, "p2": 0.0,
        "train_filenames": ["images/0.png", "images/1.png"],
        "test_filenames": ["images/3.png"],
        "applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]],
        "ply_file_path": "sparse_pc.ply",
        "frames": frames("images", ".png"),
    });
    nerfstudio["frames"][1]["mask_path"] = "masks/1.png".into();
    nerfstudio["frames"][1]["depth_file_path"] = "depth/1.png".into();
    let mut own = json!({"is_fisheye": true, "frames": frames("../images", ".jpg")});
    for (i, frame) in own["frames"]
        .as_array_mut()
        .into_iter()
        .flatten()
        .enumerate()
    {
        frame["camera_angle_x"] = (0.7 + 0.1 * i as f64).into();
        frame["distortion_params"] = json!([0.1, 0.01, 0.0, 0.0]);
    }
    let blender = json!({"camera_angle_x": 0.7, "frames": frames("./train", "")});
    let input = |json: Value, name: &str| Input(vec![json.to_string().into(), name.into()]);
    vec![
        input(nerfstudio, ""),
        input(own, ""),
        input(blender, "_train"),
    ]
}

fn mutate(input: &mut Input, rng: &mut Pcg64Mcg) {
    let file = &mut input.0[0];
    match (
        serde_json::from_slice::<Value>(file),
        rng.random_range(0..4),
    ) {
        (Ok(mut value), 0..3) => {
            mutate_json(&mut value, rng);
            *file = value.to_string().into_bytes();
        }
        (_, 0..2) => mutate::text(file, &WORDS, rng),
        _ => {
            // Into an object, where most of the words belong.
            let opened: Vec<usize> = (0..file.len()).filter(|at| file[*at] == b'{').collect();
            let at = opened.get(place(rng, opened.len())).map_or(0, |at| at + 1);
            let word = one_of(rng, &WORDS).bytes();
            file.splice(at..at, word);
        }
    }
}

/// Reads a capture; an accepted one is trained for some steps.
fn parse(input: &Input) -> Result<Follow, String> {
    let name = format!("transforms{}.json", String::from_utf8_lossy(&input.0[1]));
    let capture = parse_transforms(&name, &input.0[0]).map_err(|error| error.to_string())?;
    Ok(Box::new(move || {
        let config = TrainSettings {
            steps: 4,
            ..TrainSettings::default()
        };
        train_steps(Arc::new(capture), config, None)
    }))
}
