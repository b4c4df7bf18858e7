"""From miniSEED files and their responses to noise curves in other programs.

The files are made here, of simulated sensors whose noise is known; yours come from a data centre or
a logger.
"""

import numpy as np

import huddle

simulation = huddle.simulate("setup1", duration="10min")
simulation.write("bench.h5")
huddle.export("bench.h5", "bench.mseed")  # with the responses, bench.xml

# Nothing is imported: samples are read when the estimate needs them.
waveforms = huddle.read("bench.mseed", response="bench.xml")
print(waveforms)
print(waveforms.calibrations[0])

result = waveforms.estimate(segment="10s", band=(1, 20))
print(result)

low, high = result.interval(0.95)
truth = simulation.true_noise_psd(result.frequency)
inside = (low < truth) & (truth < high)
used = (result.frequency > 1) & (result.frequency < 20)
print(f"{np.mean(inside[used]):.0%} of the intervals from 1 to 20 Hz contain the true noise")

result.save("noise.nc")
huddle.export(result, "noise.csv")
noise = huddle.load("noise.nc").noise_psd.isel(estimate=0)
print(noise.sel(frequency=10, method="nearest").to_series())
