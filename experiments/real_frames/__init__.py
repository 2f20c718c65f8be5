"""How far are imagined patches from those of real depth cameras?"""
