"""Do views and readings of touches sort themselves alike?"""
