//! Read a simulated LabJack with a client we did not write, for the tests, which compile it.
//!
//!     peer HOST:502 HOST:702 spontaneous|command-response SCANS
//!
//! prints the calibration of the +-10 V range, then the samples of CORE_TIMER, its upper half,
//! AIN0 and AIN1, one scan a line.
use async_labjack::client::{LabjackClient, LabjackInteractions};
use async_labjack::helpers::calibrations::T7Calibrations;
use async_labjack::helpers::stream::process_stream;
use async_labjack::labjack::StreamConfigBuilder;
use async_labjack::{AIN0, AIN1, CORE_TIMER, STREAM_DATA_CAPTURE_16};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::time::{sleep, Duration};

const TAGS: u32 = 4;
const RATE: f32 = 1000.0;

#[tokio::main(flavor = "current_thread")]
async fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let scans: u32 = arguments[4].parse().unwrap();
    let spontaneous = arguments[3] == "spontaneous";
    let mut client =
        LabjackClient::connect_with_timeout(arguments[1].parse().unwrap(), Duration::from_secs(5))
            .await
            .unwrap();
    client.stop_stream().await.unwrap();
    let calibrations: T7Calibrations = client.read_calibrations().await.unwrap().try_into().unwrap();
    let range = calibrations.hs_gain_1_ain_cal;
    println!("{} {} {}", range.binary_center, range.positive_slope, range.negative_slope);
    let config = StreamConfigBuilder::default()
        .num_addresses(TAGS)
        .scan_rate(RATE)
        .num_scans(scans)
        .buffer_size_bytes(32768)
        .auto_target(if spontaneous { 1 } else { 16 })
        .samples_per_packet(100)
        .build()
        .unwrap();
    let tags = vec![CORE_TIMER.into(), STREAM_DATA_CAPTURE_16.into(), AIN0.into(), AIN1.into()];
    let mut samples: Vec<u16> = Vec::new();
    if spontaneous {
        let stream = TcpStream::connect(&arguments[2]).await.unwrap();
        client.start_stream(&config, tags).await.unwrap();
        let (tx, mut rx) = mpsc::channel(1 << 20);
        process_stream(stream, &tx, Duration::from_secs(5)).await.unwrap();
        drop(tx);
        while let Some(sample) = rx.recv().await {
            samples.push(sample);
        }
    } else {
        client.start_stream(&config, tags).await.unwrap();
        let wanted = (scans * TAGS) as usize;
        while samples.len() < wanted {
            sleep(Duration::from_millis(50)).await;
            let left = (wanted - samples.len()) as u16;
            samples.extend(client.read_stream_cr(left).await.unwrap());
        }
    }
    let actual = client.read_stream_config().await.unwrap().scan_rate;
    assert_eq!(actual, RATE);
    for scan in samples.chunks(TAGS as usize) {
        let line: Vec<String> = scan.iter().map(u16::to_string).collect();
        println!("{}", line.join(" "));
    }
    client.disconnect().await.unwrap();
}
