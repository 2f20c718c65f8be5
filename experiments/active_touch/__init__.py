"""Which policy of touching tells objects apart soonest, on pads that no policy was trained on?"""
