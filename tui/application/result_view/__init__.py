"""The Result view: verdict, margins and noise of a test that has ended."""
