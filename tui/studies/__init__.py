"""The paper's figures reproduced: simulated, estimated, judged by theory."""
